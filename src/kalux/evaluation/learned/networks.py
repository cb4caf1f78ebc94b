"""The networks, in PyTorch. A network is a pure function: (voxel grid, state) to (image, following state).

`FireNet` is that of Scheerlinck et al., "Fast Image Reconstruction with an Event Camera" (WACV 2020); `RecurrentUNet`
that of Rebecq et al., "High Speed and High Dynamic Range Video with an Event Camera" (T-PAMI 2021); Stoffregen et
al., "Reducing the Sim-to-Real Gap for Event Cameras" (ECCV 2020), train both anew as FireNet+ and E2VID+ (ECNN).
Ercan et al., "HyperE2VID" (TIP 2024), replace the first decoder by `DynamicDecoder`. The names of the attributes are
those of the published tensors.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from kalux.evaluation.learned.catalogue import Activation

RESIDUAL_KERNEL: Final = 3
GATE_KERNEL: Final = 3


class FireNetDesign(NamedTuple):
    """Sizes of a `FireNet`: 5, 16, 3 as published."""

    bins: int
    channels: int
    kernel: int


class UNetDesign(NamedTuple):
    """Sizes of a `RecurrentUNet`.

    Attributes
    ----------
    bins, channels, kernel
        5, 32, 5 as published.
    encoders, residuals
        How many; 3 and 2 as published.
    outputs
        1, or 3 where optical flow is predicted beside the image.
    batch_norm
        Whether all but the first layer are normalised (E2VID).
    transposed
        Whether decoders are transposed convolutions (E2VID's lightweight model), not upsampling and convolution.
    dynamic
        Whether the first decoder is dynamic (HyperE2VID): None, or the sizes of it.
    """

    bins: int
    channels: int
    kernel: int
    encoders: int
    residuals: int
    outputs: int
    batch_norm: bool
    transposed: bool
    dynamic: DynamicDesign | None


class DynamicDesign(NamedTuple):
    """Sizes of a `DynamicDecoder`: channels of the context and of the hidden layer, atoms, bases: 32, 64, 6, 12."""

    context: int
    hidden: int
    atoms: int
    bases: int


class Convolution(nn.Module):
    """Convolution, perhaps batch normalisation, perhaps a rectifier."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: int,
        *,
        stride: int = 1,
        norm: bool = False,
        relu: bool = True,
    ) -> None:
        super().__init__()
        self.conv2d = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=not norm)
        self.norm_layer = nn.BatchNorm2d(outputs) if norm else None
        self._relu = relu

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs, H, W) to (N, outputs, H / stride, W / stride)."""
        x = _normed(self.norm_layer, self.conv2d(x))
        return torch.relu(x) if self._relu else x


class UpsamplingDecoder(Convolution):
    """Twice the size, linearly, and a convolution."""

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs, H, W) to (N, outputs, 2 H, 2 W)."""
        return super().forward(_twice(x))


class TransposedDecoder(nn.Module):
    """Twice the size by a transposed convolution."""

    def __init__(self, inputs: int, outputs: int, kernel: int, *, norm: bool = False) -> None:
        super().__init__()
        self.transposed_conv2d = nn.ConvTranspose2d(
            inputs, outputs, kernel, stride=2, padding=kernel // 2, output_padding=1, bias=not norm
        )
        self.norm_layer = nn.BatchNorm2d(outputs) if norm else None

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs, H, W) to (N, outputs, 2 H, 2 W)."""
        return torch.relu(_normed(self.norm_layer, self.transposed_conv2d(x)))


class Residual(nn.Module):
    """Two convolutions that change what passes by them."""

    def __init__(self, channels: int, *, norm: bool = False) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, RESIDUAL_KERNEL, padding=1, bias=not norm)
        self.conv2 = nn.Conv2d(channels, channels, RESIDUAL_KERNEL, padding=1, bias=not norm)
        self.bn1 = nn.BatchNorm2d(channels) if norm else None
        self.bn2 = nn.BatchNorm2d(channels) if norm else None

    def forward(self, x: Tensor) -> Tensor:
        """Of the same shape."""
        changed = torch.relu(_normed(self.bn1, self.conv1(x)))
        return torch.relu(x + _normed(self.bn2, self.conv2(changed)))


class GatedUnit(nn.Module):
    """Convolutional gated recurrent unit (Ballas et al., ICLR 2016); its state is its output."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.reset_gate, self.update_gate, self.out_gate = (
            nn.Conv2d(2 * channels, channels, GATE_KERNEL, padding=1) for _ in range(3)
        )

    def forward(self, x: Tensor, state: Tensor | None) -> Tensor:
        """The following state."""
        before = torch.zeros_like(x) if state is None else state
        joined = torch.cat([x, before], 1)
        update = torch.sigmoid(self.update_gate(joined))
        kept = torch.sigmoid(self.reset_gate(joined)) * before
        proposed = torch.tanh(self.out_gate(torch.cat([x, kept], 1)))
        return (1 - update) * before + update * proposed


class LongMemory(nn.Module):
    """Convolutional LSTM (Shi et al., NeurIPS 2015) without peepholes; its state is (output, cell)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.Gates = nn.Conv2d(2 * channels, 4 * channels, GATE_KERNEL, padding=1)

    def forward(self, x: Tensor, state: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor]:
        """The following state."""
        output, cell = (torch.zeros_like(x), torch.zeros_like(x)) if state is None else state
        enter, keep, leave, proposed = self.Gates(torch.cat([x, output], 1)).chunk(4, 1)
        cell = torch.sigmoid(keep) * cell + torch.sigmoid(enter) * torch.tanh(proposed)
        return torch.sigmoid(leave) * torch.tanh(cell), cell


class FireNet(nn.Module):
    """A convolution, twice a gated unit and a residual block, and a prediction, all at full size."""

    multiple: Final = 1
    """Height and width have to be multiples of it."""

    def __init__(self, design: FireNetDesign) -> None:
        super().__init__()
        self.bins = design.bins
        self.head = Convolution(design.bins, design.channels, design.kernel)
        self.G1, self.G2 = GatedUnit(design.channels), GatedUnit(design.channels)
        self.R1, self.R2 = Residual(design.channels), Residual(design.channels)
        self.pred = Convolution(design.channels, 1, 1, relu=False)

    def forward(self, grid: Tensor, state: Any = None) -> tuple[Tensor, Any]:
        """(N, bins, H, W) and the state, None at first, to the image (N, 1, H, W) and the following state."""
        first, second = state or (None, None)
        first = self.G1(self.head(grid), first)
        second = self.G2(self.R1(first), second)
        return self.pred(self.R2(second)), (first, second)


class _Encoder(nn.Module):
    """Half the size and twice the channels, with memory."""

    def __init__(self, inputs: int, kernel: int, *, norm: bool) -> None:
        super().__init__()
        self.conv = Convolution(inputs, 2 * inputs, kernel, stride=2, norm=norm)
        self.recurrent_block = LongMemory(2 * inputs)

    def forward(self, x: Tensor, state: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor]:
        """The following state, of which the first is the output."""
        following: tuple[Tensor, Tensor] = self.recurrent_block(self.conv(x), state)
        return following


class _ContextFusion(nn.Module):
    """Events and previous image, a quarter of the size."""

    def __init__(self, bins: int, outputs: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(bins + 1, outputs, 3, padding=1)

    def forward(self, grid: Tensor, previous: Tensor) -> Tensor:
        """(N, outputs, H / 4, W / 4)."""
        joined = torch.cat([grid, previous], 1)
        small = functional.interpolate(joined, scale_factor=0.25, mode="bilinear", align_corners=False)
        return self.conv(small)


class _AtomGeneration(nn.Module):
    """Kernels for every pixel, as sums of Fourier-Bessel bases, which are stored with the weights."""

    def __init__(self, design: DynamicDesign, kernel: int) -> None:
        super().__init__()
        coefficients = design.atoms * design.bases
        self.bases_net = nn.Sequential(
            nn.Conv2d(design.context, design.hidden, 3, padding=1),
            nn.BatchNorm2d(design.hidden),
            nn.Tanh(),
            nn.Conv2d(design.hidden, coefficients, 3, padding=1),
            nn.BatchNorm2d(coefficients),
            nn.Tanh(),
        )
        self.register_buffer("bases", torch.zeros(design.bases, kernel**2))
        self._atoms = design.atoms

    def forward(self, context: Tensor) -> Tensor:
        """(N, atoms, kernel^2, h, w)."""
        found = self.bases_net(context).unflatten(1, (self._atoms, -1))
        return torch.einsum("nabhw,bk->nakhw", found, self.bases)


class _DynamicConvolution(nn.Module):
    """Every channel by every atom, and a weighted sum of all."""

    def __init__(self, inputs: int, outputs: int, kernel: int, atoms: int) -> None:
        super().__init__()
        self.compositional_coefficients = nn.Parameter(torch.zeros(outputs, inputs * atoms, 1, 1))
        self.bias = nn.Parameter(torch.zeros(outputs))
        self._kernel = kernel

    def forward(self, x: Tensor, atoms: Tensor) -> Tensor:
        """(N, inputs, h, w) to (N, outputs, h, w)."""
        height, width = x.shape[-2:]
        patches = functional.unfold(x, self._kernel, padding=self._kernel // 2)
        patches = patches.unflatten(1, (x.shape[1], -1)).unflatten(-1, (height, width))
        filtered = torch.einsum("nakhw,nckhw->ncahw", atoms, patches).flatten(1, 2)
        return functional.conv2d(filtered, self.compositional_coefficients, self.bias)


class DynamicDecoder(nn.Module):
    """Twice the size, and a convolution with kernels that the events and the previous image decide."""

    def __init__(self, inputs: int, outputs: int, kernel: int, bins: int, design: DynamicDesign) -> None:
        super().__init__()
        self.context_fusion = _ContextFusion(bins, design.context)
        self.dynamic_atom_generation = _AtomGeneration(design, kernel)
        self.dynamic_conv = _DynamicConvolution(inputs, outputs, kernel, design.atoms)

    def forward(self, x: Tensor, grid: Tensor, previous: Tensor) -> Tensor:
        """(N, inputs, H / 8, W / 8) to (N, outputs, H / 4, W / 4)."""
        atoms = self.dynamic_atom_generation(self.context_fusion(grid, previous))
        return torch.relu(self.dynamic_conv(_twice(x), atoms))


class RecurrentUNet(nn.Module):
    """Encoders with memory, residual blocks, decoders; what is skipped is added."""

    def __init__(self, design: UNetDesign, activation: Activation) -> None:
        super().__init__()
        self.bins, self.multiple = design.bins, 2**design.encoders
        norm, kernel = design.batch_norm, design.kernel
        widths = [design.channels * 2**level for level in range(design.encoders + 1)]
        self.head = Convolution(design.bins, widths[0], kernel)
        self.encoders = nn.ModuleList(_Encoder(width, kernel, norm=norm) for width in widths[:-1])
        self.resblocks = nn.ModuleList(Residual(widths[-1], norm=norm) for _ in range(design.residuals))
        decoder = TransposedDecoder if design.transposed else UpsamplingDecoder
        decoders = [decoder(width, width // 2, kernel, norm=norm) for width in widths[:0:-1]]
        if design.dynamic is not None:
            deepest = widths[-1]
            decoders[0] = DynamicDecoder(deepest, deepest // 2, kernel, design.bins, design.dynamic)
        self.decoders = nn.ModuleList(decoders)
        self.pred = Convolution(widths[0], design.outputs, 1, norm=norm, relu=False)
        self._sigmoid = activation == "sigmoid"

    def forward(self, grid: Tensor, state: Any = None) -> tuple[Tensor, Any]:
        """(N, bins, H, W) and the state, None at first, to the image (N, 1, H, W) and the following state."""
        memories, previous = state or ([None] * len(self.encoders), torch.zeros_like(grid[:, :1]))
        x = head = self.head(grid)
        following = []
        for encoder, memory in zip(self.encoders, memories, strict=True):
            following.append(encoder(x, memory))
            x = following[-1][0]
        for block in self.resblocks:
            x = block(x)
        for decoder, (skipped, _) in zip(self.decoders, reversed(following), strict=True):
            x = x + skipped
            x = decoder(x, grid, previous) if isinstance(decoder, DynamicDecoder) else decoder(x)
        image = self.pred(x + head)[:, :1]
        image = torch.sigmoid(image) if self._sigmoid else image
        return image, (following, image)


Network = FireNet | RecurrentUNet


def _normed(norm: nn.Module | None, x: Tensor) -> Tensor:
    return x if norm is None else norm(x)


def _twice(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
