"""The demonstration, on a smaller and shorter scene."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import kalux
from kalux.cli import main
from kalux.datasets import demo_scene
from kalux.demo import run_demo
from kalux.errors import InputError, OutputError


@pytest.fixture(scope="module")
def small_scene():
    return demo_scene(sensor_size=(45, 60), duration=240_000)


@pytest.fixture(scope="module")
def demo(tmp_path_factory, small_scene):
    out = tmp_path_factory.mktemp("demo")
    return out, run_demo(out, scene=small_scene, moment=180_000)


def test_the_akf_is_nearest_to_the_truth(demo):
    held, cf, akf = demo[1]
    assert akf.log_mse < cf.log_mse
    assert akf.log_mse < held.log_mse
    assert akf.mse < held.mse


def test_everything_is_written(demo):
    out, _ = demo
    assert {file.name for file in out.iterdir()} == {
        "demo.h5",
        "demo.mp4",
        "demo.mp4.kalux.toml",
        "demo.png",
    }
    assert cv2.imread(str(out / "demo.png")).std() > 20


def test_its_recording_can_be_reconstructed(demo, tmp_path):
    out, _ = demo
    recording = kalux.open(out / "demo.h5")
    assert recording.contrast_threshold == (0.2, 0.24)
    assert recording.ground_truth() is not None
    assert main(["reconstruct", str(out / "demo.h5"), "-o", str(tmp_path / "v.mp4"), "--quiet"]) == 0


def test_it_repeats_itself(demo, small_scene, tmp_path):
    again = run_demo(tmp_path, scene=small_scene, moment=180_000)
    assert again == demo[1]
    assert (tmp_path / "demo.png").read_bytes() == (demo[0] / "demo.png").read_bytes()


def test_the_command_prints_a_table_and_what_to_look_at(demo, tmp_path, monkeypatch, capsys, small_scene):
    monkeypatch.setattr("kalux.demo.demo_scene", lambda: small_scene)
    monkeypatch.setattr("kalux.demo.MOMENT", 180_000)
    assert main(["demo", "-o", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert "log-MSE" in out
    assert "kalux (AKF)" in out
    assert f"kalux reconstruct {tmp_path}/out/demo.h5" in out


def test_a_folder_with_other_things_is_refused(demo, tmp_path, capsys):
    (tmp_path / "mine").write_text("")
    with pytest.raises(OutputError, match="not empty"):
        run_demo(tmp_path)
    assert main(["demo", "-o", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("written", [False, True])
def test_an_interrupt_says_what_is_there(tmp_path, capsys, monkeypatch, written):
    def interrupt(*arguments):
        if written:
            (tmp_path / "out" / "demo.h5").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr("kalux.demo.simulate", interrupt)
    assert main(["demo", "-o", str(tmp_path / "out")]) == 130
    told = f"what is in {tmp_path / 'out'} is whole; kalux demo --overwrite makes the rest"
    assert capsys.readouterr().err == f"kalux: interrupted; {told if written else 'nothing was written'}\n"


def test_a_moment_without_frames_is_refused(tmp_path, small_scene):
    with pytest.raises(InputError, match="moment"):
        run_demo(tmp_path, scene=small_scene, moment=10**9)
    assert not any(tmp_path.iterdir())


def test_the_frame_is_the_last_one_finished():
    from kalux.demo import held_frame

    frames = [kalux.Frame(np.full((1, 1), v, np.uint8), t, t + 5) for v, t in ((0, 0), (255, 10))]
    assert held_frame(frames, 14) == 0
    assert held_frame(frames, 15) == 1
