"""Keypoints of a picture, found by a small convolutional network: the eyes of the `cnn` policy."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import torch
from torch import Tensor, nn

NUMBERS = 4  # a keypoint: x, y, spread, strength
STRIDE = 4  # of heat maps [pixels]
_LIGHT, _COLOUR = 4.0, 16.0  # pictures differ in light much more than in colour; these make them alike
_SHARPNESS = 3.0  # of the softmax
_SPREAD, _STRENGTH = 4.0, 0.3  # bring both to about -2 to 2


class KeypointEncoder(nn.Module):
    """A few convolutions and a spatial softmax.

    (Levine et al., End-to-end training of deep visuomotor policies, JMLR 2016, section 5.1.) Every keypoint is a
    channel's softmax over the picture. Of it come the mean x and y, -1 to 1, finer than a pixel, and two numbers
    more: the deviation, which says how large a thing is and so how far away; and the mean activation, which says
    whether the thing is to be seen at all, as the softmax of nothing is a place too.

    A keypoint learns only from what it looks at, so some must begin on every small thing of a colour of its own.
    Hence the picture is split into light and colour, and the weights begin with variance 2 / inputs (He et al.,
    Delving deep into rectifiers, ICCV 2015, Eq. 10). With red, green and blue and torch's own weights every softmax
    began as the mean over the picture, and in 1,100 steps a goal of 5 pixels was not found; so it is in 300.

    channels: of the layers; the first two halve the picture's sides. keeps_maps: have `maps`, logarithms of the last
    pictures' heat maps, (B, K, height, width), while learning.
    """

    maps: Tensor | None = None

    def __init__(self, channels: Sequence[int], keypoints: int, *, keeps_maps: bool = False) -> None:
        super().__init__()
        self.keeps_maps = keeps_maps
        layers: list[nn.Module] = []
        for i, (inputs, outputs) in enumerate(zip((3, *channels[:-1]), channels, strict=True)):
            kernel = 5 if i == 0 else 3
            layers += [nn.Conv2d(inputs, outputs, kernel, stride=2 if i < 2 else 1, padding=kernel // 2), nn.ReLU()]
        self.layers = nn.Sequential(*layers)
        self.heat = nn.Conv2d(channels[-1], keypoints, 1)
        for layer in (*self.layers, self.heat):
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
        self.size = NUMBERS * keypoints

    def forward(self, pictures: Tensor) -> Tensor:
        """Return numbers of the keypoints, (B, 4 K) in single precision, from pictures (B, 3, H, W) from 0 to 1."""
        # Channels last is faster on a CPU. The weights stay contiguous, as safetensors wants an optimiser's state.
        features = self.layers(_light_and_colour(pictures).contiguous(memory_format=torch.channels_last))
        # In half precision a keypoint would jump from pixel to pixel.
        with torch.autocast(pictures.device.type, enabled=False):
            return self._keypoints(features.float())

    def _keypoints(self, features: Tensor) -> Tensor:
        """Numbers of the keypoints, (B, 4 K), from features (B, C, height, width)."""
        height, width = features.shape[2:]
        # A convolution of one pixel as a product, whose result lies in memory as the softmax wants it.
        cells = features.permute(0, 2, 3, 1).flatten(1, 2).transpose(1, 2)  # (B, C, cells), without a copy
        heat = self.heat.weight.flatten(1) @ cells + self.heat.bias.unsqueeze(1)  # type: ignore[union-attr]
        weights = (_SHARPNESS * heat).softmax(-1)
        if self.training and self.keeps_maps:
            self.maps = (_SHARPNESS * heat).log_softmax(-1).unflatten(-1, (height, width))
        moments = weights @ _places(height, width, heat.device)
        x, y = moments[..., 0], moments[..., 1]
        variance = moments[..., 2] - x.square() - y.square()
        spread = variance.clamp(min=1e-6).sqrt()
        strength = (weights * heat).sum(-1)
        return torch.cat([x, y, _SPREAD * spread, _STRENGTH * strength], dim=-1)


def _places(height: int, width: int, device: torch.device) -> Tensor:
    """Across, down, and the sum of their squares, of every cell of a heat map, row by row, (height width, 3)."""
    x = torch.linspace(-1.0, 1.0, width, device=device).repeat(height)
    y = torch.linspace(-1.0, 1.0, height, device=device).repeat_interleave(width)
    return torch.stack([x, y, x.square() + y.square()], dim=1)


def heat_map_losses(maps: Tensor, places: Tensor) -> Tensor:
    """Return the mean cross-entropy [nats] of the points in view, (B,), 0 if none is.

    maps: logarithms of heat maps (B, K, height, width), whose cells are `STRIDE` pixels apart from the first pixel on.
    places: across and down from 0 to 1, and whether that is in view, (B, K, 3); a place between cells counts for the
    four around it, the nearer the more.
    """
    size = torch.tensor([maps.shape[3], maps.shape[2]], device=maps.device)
    at = ((places[..., :2] * STRIDE * size - 0.5) / STRIDE).clamp(min=0).minimum(size - 1.0)
    low = at.floor().minimum(size - 2.0)
    share, low = at - low, low.long()
    losses = torch.zeros_like(share[..., 0])
    for right, below in product((0, 1), repeat=2):
        weight = (share[..., 0] if right else 1 - share[..., 0]) * (share[..., 1] if below else 1 - share[..., 1])
        cell = (low[..., 1] + below) * maps.shape[3] + low[..., 0] + right
        losses = losses - weight * maps.flatten(2).gather(2, cell.unsqueeze(-1)).squeeze(-1)
    seen = places[..., 2]
    return (losses * seen).sum(1) / seen.sum(1).clamp(min=1)


def _light_and_colour(pictures: Tensor) -> Tensor:
    """Mean of red, green and blue, and what red and green have more than that, (B, 3, H, W)."""
    light = pictures.mean(1, keepdim=True)
    return torch.cat([_LIGHT * (light - 0.5), _COLOUR * (pictures[:, :2] - light)], dim=1)
