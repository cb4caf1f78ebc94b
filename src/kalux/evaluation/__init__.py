"""Metrics of reconstructed images against a reference: `hdr_vdp` for what an observer sees, `metrics` for the rest."""

from __future__ import annotations

from kalux.evaluation.hdr_vdp import HdrVdp, hdrvdp
from kalux.evaluation.metrics import log_mse, mse, psnr, ssim, ssim_released

__all__ = ["HdrVdp", "hdrvdp", "log_mse", "mse", "psnr", "ssim", "ssim_released"]
