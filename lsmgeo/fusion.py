"""Fusion of views: modules of one protocol, from per-view volumes to one.

Each maps ``(volume (B, V, C, *sites), visible (B, V, *sites), view_mask (B, V) or None)`` to (B, C, *sites),
with any number of views and ragged scenes. The recurrent ones have weights, and also return the state after every view.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lsmgeo._checks import check_devices, check_flag, check_float, check_mask, check_number, check_whole
from lsmgeo.errors import OptionError, ShapeError
from lsmgeo.functional import view_statistics

__all__ = ["ConvGRU3d", "ConvLSTM3d", "Max", "Mean", "Variance"]


class _Statistic(nn.Module):
    name: str

    def forward(self, volume: Tensor, visible: Tensor, view_mask: Tensor | None = None) -> Tensor:
        """Reduce (B, V, C, *sites) over the visible views to (B, C, *sites)."""
        return view_statistics(volume, visible, self.name, view_mask)


class Mean(_Statistic):
    """Mean over the views that see a site, 0 where none does.

    Example:
        >>> import torch
        >>> from lsmgeo.fusion import Mean
        >>> volume = torch.tensor([1.0, 3.0, 8.0]).reshape(1, 3, 1, 1)
        >>> Mean()(volume, torch.tensor([[[True], [True], [False]]]))
        tensor([[[2.]]])
    """

    name = "mean"


class Variance(_Statistic):
    """Population variance over the views that see a site (as in MVSNet): the mean of squares about the mean.

    Example:
        >>> import torch
        >>> from lsmgeo.fusion import Variance
        >>> volume = torch.tensor([1.0, 3.0, 8.0]).reshape(1, 3, 1, 1)
        >>> Variance()(volume, torch.tensor([[[True], [True], [False]]]))
        tensor([[[1.]]])
    """

    name = "variance"


class Max(_Statistic):
    """Maximum over the views that see a site; its gradient goes to the first view that attains it.

    Example:
        >>> import torch
        >>> from lsmgeo.fusion import Max
        >>> volume = torch.tensor([1.0, 3.0, 8.0]).reshape(1, 3, 1, 1)
        >>> Max()(volume, torch.tensor([[[True], [True], [False]]]))
        tensor([[[3.]]])
    """

    name = "max"


def _odd(who: str, name: str, value: int) -> int:
    if check_whole(who, name, value, 1) % 2 == 0:
        raise OptionError(f"{who}: {name} must be odd; got {value}")
    return value


class _Recurrent(nn.Module):
    """The loop over views that the recurrent fusions share; subclasses hold the weights of one step.

    The convolution over [input, state] is the sum of one over the input, which is computed for all views at once, and
    one over the state. The first state is 0, so that the first view needs no convolution of it.
    """

    parts: int  # what a step computes from its input: gates and candidate

    def __init__(
        self,
        in_channels: int,
        hidden_channels: int,
        *,
        kernel_size: int = 3,
        state_kernel_size: int | None = None,
        norm: bool = True,
        eps: float = 1e-5,
    ) -> None:
        super().__init__()
        who = type(self).__name__
        self.in_channels = check_whole(who, "in_channels", in_channels, 1)
        self.hidden_channels = check_whole(who, "hidden_channels", hidden_channels, 1)
        self.kernel_size = _odd(who, "kernel_size", kernel_size)
        self.state_kernel_size = _odd(
            who, "state_kernel_size", kernel_size if state_kernel_size is None else state_kernel_size
        )
        self.norm = check_flag(who, "norm", norm)
        self.eps = check_number(who, "eps", eps, "a small number")
        # A norm cancels a bias.
        self.input = nn.Conv3d(
            self.in_channels,
            self.parts * self.hidden_channels,
            self.kernel_size,
            padding=self.kernel_size // 2,
            bias=not norm,
        )
        self._build()
        self._initialise()

    def _build(self) -> None:
        """Create the layers that depend on the recurrence: the convolutions over the state, and the norms."""
        raise NotImplementedError

    def _of_state(self, parts: int) -> nn.Conv3d:
        size, channels = self.state_kernel_size, self.hidden_channels
        return nn.Conv3d(channels, parts * channels, size, padding=size // 2, bias=False)

    def _layer_norm(self) -> nn.Module:
        return nn.GroupNorm(1, self.hidden_channels, self.eps) if self.norm else nn.Identity()

    def _initialise(self) -> None:
        """Xavier-uniform weights, as of one convolution over [input, state]."""
        fans = self.in_channels * self.kernel_size**3 + 2 * self.hidden_channels * self.state_kernel_size**3
        bound = (6.0 / fans) ** 0.5
        for module in self.modules():
            if isinstance(module, nn.Conv3d):
                nn.init.uniform_(module.weight, -bound, bound)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    def _step(self, inputs: tuple[Tensor, ...], state: tuple[Tensor, ...] | None) -> tuple[Tensor, ...]:
        """The state after a view; its first tensor is the output."""
        raise NotImplementedError

    def _outputs(self, volume: Tensor, view_mask: Tensor | None) -> list[Tensor]:
        who = type(self).__name__
        check_float(who, "volume", volume, "(B, V, C, D, H, W)", 6)
        if volume.shape[1] < 1 or volume.shape[2] != self.in_channels:
            raise ShapeError(
                f"{who}: volume must be (B, V, C, D, H, W) with V at least 1 and C = {self.in_channels}; "
                f"got {tuple(volume.shape)}"
            )
        B, V = volume.shape[:2]
        if view_mask is not None:
            check_mask(who, "view_mask", view_mask, (B, V), "(B, V)")
            check_devices(who, volume=volume, view_mask=view_mask)
            # Selecting between states is not enough: 0 times a NaN in backward is a NaN in the weights.
            volume = torch.where(view_mask[:, :, None, None, None, None], volume, 0.0)
        inputs = self.input(volume.flatten(0, 1)).unflatten(0, (B, V))
        outputs: list[Tensor] = []
        state: tuple[Tensor, ...] | None = None
        for view, x in enumerate(inputs.unbind(1)):
            new = self._step(x.chunk(self.parts, 1), state)
            if view_mask is not None:
                is_there = view_mask[:, view, None, None, None, None]
                old = tuple(torch.zeros_like(part) for part in new) if state is None else state
                new = tuple(torch.where(is_there, after, before) for after, before in zip(new, old, strict=True))
            state = new
            outputs.append(state[0])
        return outputs

    def states(self, volume: Tensor, visible: Tensor | None = None, view_mask: Tensor | None = None) -> Tensor:
        """The state after every view.

        Args:
            volume: (B, V, C, D, H, W), V at least 1.
            visible: part of the protocol, not used: invisible sites are 0 in the volume already.
            view_mask: (B, V) bool; a masked view is not read and does not change the state.

        Returns:
            (B, V, C', D, H, W).

        Raises:
            ShapeError, DTypeError, DeviceError: see `lsmgeo.errors`.
        """
        return torch.stack(self._outputs(volume, view_mask), 1)

    def forward(self, volume: Tensor, visible: Tensor | None = None, view_mask: Tensor | None = None) -> Tensor:
        """The state after the last view, (B, C', D, H, W); see `states`."""
        return self._outputs(volume, view_mask)[-1]

    def extra_repr(self) -> str:
        """The arguments."""
        return (
            f"{self.in_channels}, {self.hidden_channels}, kernel_size={self.kernel_size}, "
            f"state_kernel_size={self.state_kernel_size}, norm={self.norm}, eps={self.eps:g}"
        )


class ConvGRU3d(_Recurrent):
    """Fuse views in sequence with a gated recurrent unit of 3D convolutions.

    Equation: with * a convolution, LN layer normalisation over channels and voxels with a gain and a shift per channel,
    x a view's volume and h the state, 0 before the first view: ``r = sigmoid(LN(W_r * [x, h]))``,
    ``u = sigmoid(LN(W_u * [x, h]))``, ``c = tanh(LN(W_c * [x, r h]))``, ``h' = u h + (1 - u) c`` (Kar, Haene and Malik,
    "Learning a Multi-View Stereo Machine", 2017, section 3; layer norm as in their release).

    Args:
        in_channels: C of the volumes.
        hidden_channels: C' of the state.
        kernel_size: of the convolutions over a view's volume, odd.
        state_kernel_size: of those over the state, odd; by default `kernel_size`.
        norm: whether to normalise; without, the convolutions over x have a bias.
        eps: of the normalisation.

    Shape:
        - volume: (B, V, C, D, H, W); visible: not used; view_mask: (B, V) bool.
        - result: (B, C', D, H, W) in [-1, 1]; `states` gives (B, V, C', D, H, W), the state after every view.

    Raises:
        OptionError: an invalid option.

    Example:
        >>> import torch
        >>> from lsmgeo.fusion import ConvGRU3d
        >>> fusion = ConvGRU3d(5, 3)
        >>> volume = torch.rand(2, 4, 5, 6, 6, 6)
        >>> tuple(fusion(volume).shape), tuple(fusion.states(volume).shape)
        ((2, 3, 6, 6, 6), (2, 4, 3, 6, 6, 6))
    """

    parts = 3

    def _build(self) -> None:
        self.state_gates = self._of_state(2)
        self.state_candidate = self._of_state(1)
        self.reset_norm = self._layer_norm()
        self.update_norm = self._layer_norm()
        self.candidate_norm = self._layer_norm()

    def _step(self, inputs: tuple[Tensor, ...], state: tuple[Tensor, ...] | None) -> tuple[Tensor, ...]:
        reset, update, candidate = inputs
        if state is None:
            kept = self.update_norm(update).sigmoid()
            return ((1.0 - kept) * self.candidate_norm(candidate).tanh(),)
        (hidden,) = state
        state_reset, state_update = self.state_gates(hidden).chunk(2, 1)
        read = self.reset_norm(reset + state_reset).sigmoid()
        kept = self.update_norm(update + state_update).sigmoid()
        new = self.candidate_norm(candidate + self.state_candidate(read * hidden)).tanh()
        return (new + kept * (hidden - new),)


class ConvLSTM3d(_Recurrent):
    """Fuse views in sequence with a long short-term memory of 3D convolutions.

    Equation: with * a convolution, LN layer normalisation over channels and voxels with a gain and a shift per channel,
    x a view's volume, h the output and m the memory, both 0 before the first view: ``g, i, f, o = LN(W * [x, h])``,
    each normalised by itself, ``m' = LN(m sigmoid(f + 1) + sigmoid(i) tanh(g))``, ``h' = tanh(m') sigmoid(o)`` (the
    other recurrence of the release of Kar, Haene and Malik, "Learning a Multi-View Stereo Machine", 2017).

    Args:
        in_channels: C of the volumes.
        hidden_channels: C' of the output.
        kernel_size: of the convolutions over a view's volume, odd.
        state_kernel_size: of those over the state, odd; by default `kernel_size`.
        norm: whether to normalise; without, the convolution over x has a bias.
        eps: of the normalisation.

    Shape:
        - volume: (B, V, C, D, H, W); visible: not used; view_mask: (B, V) bool.
        - result: (B, C', D, H, W) in [-1, 1]; `states` gives (B, V, C', D, H, W), the output after every view.

    Raises:
        OptionError: an invalid option.

    Example:
        >>> import torch
        >>> from lsmgeo.fusion import ConvLSTM3d
        >>> fusion = ConvLSTM3d(5, 3)
        >>> volume = torch.rand(2, 4, 5, 6, 6, 6)
        >>> tuple(fusion(volume).shape), tuple(fusion.states(volume).shape)
        ((2, 3, 6, 6, 6), (2, 4, 3, 6, 6, 6))
    """

    parts = 4

    def _build(self) -> None:
        self.state_parts = self._of_state(self.parts)
        self.norms = nn.ModuleList(self._layer_norm() for _ in range(self.parts))
        self.memory_norm = self._layer_norm()

    def _step(self, inputs: tuple[Tensor, ...], state: tuple[Tensor, ...] | None) -> tuple[Tensor, ...]:
        if state is not None:
            parts = self.state_parts(state[0]).chunk(self.parts, 1)
            inputs = tuple(ours + theirs for ours, theirs in zip(inputs, parts, strict=True))
        new, write, keep, show = (norm(part) for norm, part in zip(self.norms, inputs, strict=True))
        memory = write.sigmoid() * new.tanh()
        if state is not None:
            memory = memory + state[1] * (keep + 1.0).sigmoid()
        memory = self.memory_norm(memory)
        return memory.tanh() * show.sigmoid(), memory
