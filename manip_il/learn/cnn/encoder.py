"""Keypoints of one camera, in torch alone."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

NUMBERS = 4  # a keypoint: x, y, spread, strength
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

    channels: of the layers; the first two halve the picture's sides.
    """

    def __init__(self, channels: Sequence[int], keypoints: int) -> None:
        super().__init__()
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
            return self._keypoints(self.heat(features.float()))

    def _keypoints(self, heat: Tensor) -> Tensor:
        flat = heat.flatten(2)
        weights = (_SHARPNESS * flat).softmax(-1).view_as(heat)
        across, down = weights.sum(2), weights.sum(3)
        grid_x = torch.linspace(-1.0, 1.0, heat.shape[3], device=heat.device)
        grid_y = torch.linspace(-1.0, 1.0, heat.shape[2], device=heat.device)
        x, y = across @ grid_x, down @ grid_y
        variance = across @ grid_x.square() + down @ grid_y.square() - x.square() - y.square()
        spread = variance.clamp(min=1e-6).sqrt()
        strength = (weights.flatten(2) * flat).sum(-1)
        return torch.cat([x, y, _SPREAD * spread, _STRENGTH * strength], dim=-1)


def _light_and_colour(pictures: Tensor) -> Tensor:
    """Mean of red, green and blue, and what red and green have more than that, (B, 3, H, W)."""
    light = pictures.mean(1, keepdim=True)
    return torch.cat([_LIGHT * (light - 0.5), _COLOUR * (pictures[:, :2] - light)], dim=1)
