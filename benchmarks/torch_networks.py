"""Our networks and training step in PyTorch, to be timed beside ours. Needs the extra `torch`.

    twin = use_channels_last(TorchUnshearNet(net))
    twin.load(variables)                       # of `unshearnet.init`
    step = make_training_step(twin, training)       # step(canonical, sheared) -> loss

Layers, losses, regularisation, Adam and the moving averages are those of `unshearnet` and
`training`. Tests compare outputs and gradients.
"""

from collections.abc import Callable, Iterable
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.training import Training
from jaxunshear.files import Json
from jaxunshear.models.fast.norm import EPSILON
from jaxunshear.models.layers import MOMENTUM
from jaxunshear.models.unshearnet import Variables


def _norm(width: int) -> nn.Module:
    return nn.BatchNorm2d(width, eps=EPSILON, momentum=1 - MOMENTUM)


def _down(before: int, width: int) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(before, width, 4, 2, 1, bias=False), _norm(width), nn.ReLU(inplace=True)
    )


def _same(before: int, width: int) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(before, width, 3, 1, 1, bias=False), _norm(width), nn.ReLU(inplace=True)
    )


def _up(before: int, width: int) -> nn.Module:
    return nn.Sequential(
        nn.ConvTranspose2d(before, width, 4, 2, 1, bias=False), _norm(width), nn.ReLU(inplace=True)
    )


class TorchUnshearNet(nn.Module):
    """`unshearnet.Network`, images (B, 1, S, S) in [0, 1]."""

    def __init__(self, net: UnshearNet) -> None:
        super().__init__()
        self.net = net
        widths = net.widths
        self.E = nn.Sequential(*(_down(a, b) for a, b in zip((1, *widths), widths, strict=False)))
        codes = widths[-1]
        if net.disentangled:
            self.pose = _same(widths[-1], net.pose_channels)
            codes = net.pose_channels
            if net.shear_channels:
                self.shear = _same(widths[-1], net.shear_channels)
                self.DS = self._decoder(net.pose_channels + net.shear_channels)
        self.DC = self._decoder(codes)

    def _decoder(self, before: int) -> nn.Module:
        widths = tuple(reversed(self.net.widths[:-1]))
        ups = [_up(a, b) for a, b in zip((before, *widths), widths, strict=False)]
        return nn.Sequential(*ups, nn.ConvTranspose2d(widths[-1], 1, 4, 2, 1))

    def unshear(self, images: Tensor) -> Tensor:
        z = self.E(images)
        return torch.sigmoid(self.DC(self.pose(z) if self.net.disentangled else z))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor | None]:
        z = self.E(images)
        if not self.net.disentangled:
            return self.DC(z), None
        z_p = self.pose(z)
        if not self.net.shear_channels:
            return self.DC(z_p), None
        return self.DC(z_p), self.DS(torch.cat([z_p, self.shear(z)], 1))

    def load(self, variables: Json) -> None:
        """Copy the values of our variables."""
        params, stats = variables["params"], variables["batch_stats"]
        downs = ("First_0", *(f"Down_{i}" for i in range(len(self.net.widths) - 1)))
        _load_layers(self.E, params["E"], stats["E"], downs, False)
        for name in ("DC", "DS"):
            if name in params:
                ups = tuple(f"Up_{i}" for i in range(len(self.net.widths) - 1))
                _load_layers(list(getattr(self, name))[:-1], params[name], stats[name], ups, True)
                last, ours = getattr(self, name)[-1], params[name]["Last_0"]
                _set(last.weight, _transpose_kernel(ours["kernel"]))
                _set(last.bias, ours["bias"])
        for name in ("pose", "shear"):
            if name in params:
                _load_layer(getattr(self, name), params[name], stats[name], False)


class TorchPoseNet(nn.Module):
    """`posenet.Network`, images (B, 1, S, S) in [0, 1] -> (B, outputs)."""

    def __init__(self, net: PoseNet, outputs: int) -> None:
        super().__init__()
        first, second, *rest = net.widths
        self.layers = nn.Sequential(
            _down(1, first),
            _down(first, second),
            nn.MaxPool2d(2),
            _same(second, rest[0]),
            _same(rest[0], rest[1]),
            nn.MaxPool2d(2),
            _same(rest[1], rest[2]),
        )
        self.dense = nn.Sequential(
            nn.Linear((net.size // 16) ** 2 * rest[2], net.hidden),
            nn.ReLU(),
            nn.Linear(net.hidden, outputs),
        )

    def forward(self, images: Tensor) -> Tensor:
        channels_last = self.layers(images).permute(0, 2, 3, 1)  # flat in the order of ours
        return torch.sigmoid(self.dense(channels_last.reshape(len(images), -1)))

    def load(self, variables: Json) -> None:
        """Copy the values of our variables."""
        params, stats = variables["params"], variables["batch_stats"]
        convolutions = [layer for layer in self.layers if isinstance(layer, nn.Sequential)]
        # Flax counts an outer call before the inner one
        names = ("First_0", "Down_0", "Same_1", "Same_0", "Same_2")
        for layer, name in zip(convolutions, names, strict=True):
            _load_layer(layer, params[name], stats[name], False)
        linear: list[nn.Module] = [self.dense[0], self.dense[2]]
        for dense, name in zip(linear, ("Dense_0", "Dense_1"), strict=True):
            _set(dense.weight, np.transpose(params[name]["kernel"]))
            _set(dense.bias, params[name]["bias"])


TorchModule = TypeVar("TorchModule", bound=nn.Module)


def use_channels_last(twin: TorchModule) -> TorchModule:
    """Change to the layout in which PyTorch's convolutions are fastest on a CPU."""
    return twin.to(memory_format=torch.channels_last)


def _load_layers(
    layers: Iterable[nn.Sequential],
    params: Variables,
    stats: Variables,
    names: tuple[str, ...],
    transposed: bool,
) -> None:
    for layer, name in zip(layers, names, strict=True):
        _load_layer(layer, params[name], stats[name], transposed)


def _load_layer(
    layer: nn.Sequential, params: Variables, stats: Variables, transposed: bool
) -> None:
    kernel = params["kernel"]
    weight = _transpose_kernel(kernel) if transposed else np.transpose(kernel, (3, 2, 0, 1))
    _set(layer[0].weight, weight)
    _set(layer[1].weight, params["norm"]["scale"])
    _set(layer[1].bias, params["norm"]["bias"])
    _set(layer[1].running_mean, stats["norm"]["mean"])
    _set(layer[1].running_var, stats["norm"]["var"])


def _transpose_kernel(kernel: ArrayLike) -> np.ndarray:
    """Flip a kernel: Flax' transposed convolutions correlate, those of PyTorch convolve."""
    return np.transpose(np.asarray(kernel)[::-1, ::-1], (2, 3, 0, 1))


def _set(tensor: Tensor, value: ArrayLike) -> None:
    with torch.no_grad():
        tensor.copy_(torch.from_numpy(np.array(value, np.float32)))


def compute_losses(
    twin: TorchUnshearNet, training: Training, canonical: Tensor, sheared: Tensor
) -> Tensor:
    """Compute the total loss of images (B, 1, S, S) in [0, 1]."""
    logits, sheared_logits = twin(sheared)
    image = torch.sigmoid(logits)
    total = torch.mean((image - canonical) ** 2)
    if "patch" in training.losses:
        counts = _count_crops(len(image), twin.net.size, training, image.device)
        difference = torch.abs(image - canonical)[:, 0]
        patch = (counts * difference).sum((1, 2)) / counts.sum((1, 2))
        total = total + training.losses["patch"] * torch.mean(patch)
    if sheared_logits is not None:
        reconstruction = torch.mean((torch.sigmoid(sheared_logits) - sheared) ** 2)
        total = total + training.losses.get("reconstruction", 0.0) * reconstruction
    if training.l1 or training.l2:
        for name, kernel in twin.named_parameters():
            if name.endswith("weight") and kernel.ndim == 4:
                count = 1 if training.kernels == "sum" else kernel.numel()
                penalty = training.l1 * kernel.abs().sum() + training.l2 * (kernel**2).sum()
                total = total + penalty / count
    return total


def _count_crops(images: int, size: int, training: Training, device: torch.device) -> Tensor:
    """Count how many random crops cover each pixel."""
    shape = (images, training.crops, 2, 1)
    start = torch.randint(0, size - training.crop_px + 1, shape, device=device)
    pixel = torch.arange(size, device=device)
    covered = ((pixel >= start) & (pixel < start + training.crop_px)).float()
    return torch.einsum("bkr,bkc->brc", covered[:, :, 0], covered[:, :, 1])


def make_training_step(
    twin: TorchUnshearNet, training: Training, compiled: bool = False
) -> Callable[[Tensor, Tensor], Tensor]:
    """Make a step of Adam with moving averages, on images (B, 1, S, S) uint8 of {0, 255}."""
    tensors = [*twin.parameters(), *(b for b in twin.buffers() if b.is_floating_point())]
    average = [tensor.detach().clone() for tensor in tensors]
    adam = torch.optim.Adam(
        twin.parameters(), training.learning_rate, (training.beta1, 0.999), fused=True
    )
    compute = torch.compile(compute_losses, dynamic=False) if compiled else compute_losses

    def step(canonical: Tensor, sheared: Tensor) -> Tensor:
        canonical, sheared = _scale_to_unit(canonical), _scale_to_unit(sheared)
        adam.zero_grad(set_to_none=True)
        loss = compute(twin, training, canonical, sheared)
        loss.backward()
        adam.step()
        with torch.no_grad():
            torch._foreach_lerp_(average, tensors, 1 - training.ema_decay)
        return loss.detach()

    return step


def _scale_to_unit(images: Tensor) -> Tensor:
    return (images.float() / 255).contiguous(memory_format=torch.channels_last)
