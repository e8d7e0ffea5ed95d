"""Rows in their order, and crops and colour jitter of pictures: draws are the generator's or the
seed's alone.
"""

import numpy as np
import pytest
import torch
from torch import Tensor

from manip_il.learn.batches import Augment, Order, to_float


@pytest.fixture
def pictures() -> Tensor:
    return torch.randint(0, 256, (6, 3, 20, 24), dtype=torch.uint8, generator=generator(9))


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_the_same_draws_give_the_same_bytes(pictures: Tensor) -> None:
    augment = Augment()
    first, again, other = (augment(pictures, generator(seed)) for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    torch.manual_seed(3)  # the global generator has no say
    assert torch.equal(augment(pictures, generator(1)), first)


def test_a_crop_is_the_picture_moved_with_its_border_repeated(pictures: Tensor) -> None:
    shift = 3
    crops = Augment(shift, 0, 0, 0)(pictures, generator())
    found = [
        moves_of(crop, to_float(picture), shift)
        for crop, picture in zip(crops, pictures, strict=True)
    ]
    assert all(len(moves) == 1 for moves in found)
    assert len({moves[0] for moves in found}) > 1  # a draw a picture


def moves_of(crop: Tensor, picture: Tensor, shift: int) -> list[tuple[int, int]]:
    padded = torch.nn.functional.pad(picture[None], (shift,) * 4, mode="replicate")[0]
    height, width = picture.shape[1:]
    places = [(y, x) for y in range(2 * shift + 1) for x in range(2 * shift + 1)]
    return [
        (y, x)
        for y, x in places
        if torch.allclose(padded[:, y : y + height, x : x + width], crop, atol=1e-6)
    ]


def test_the_pictures_of_a_sample_change_together(pictures: Tensor) -> None:
    windows = pictures.view(3, 2, 3, 20, 24)
    still = windows[:, :1].expand(-1, 2, -1, -1, -1)
    changed = Augment()(still, generator())
    assert changed.shape == still.shape
    assert torch.equal(changed[:, 0], changed[:, 1])
    assert torch.equal(changed[:, 0], Augment()(still[:, 0], generator()))


def test_every_row_comes_once_an_epoch():
    order = Order(10, None, 4, seed=0)
    drawn = np.concatenate([order.batch(step) for step in range(5)])
    assert sorted(drawn[:10]) == sorted(drawn[10:]) == list(range(10))
    assert drawn[:10].tolist() != drawn[10:].tolist()
    assert np.array_equal(Order(10, None, 4, seed=0).batch(3), order.batch(3))
    assert len(Order(3, None, 8, seed=0).batch(0)) == 8


def test_rows_are_drawn_as_often_as_they_weigh():
    weights = np.array([1.0, 0.0, 3.0, 0.0])
    order = Order(4, weights, 50, seed=1)
    counts = np.bincount(np.concatenate([order.batch(step) for step in range(200)]), minlength=4)
    assert counts[[1, 3]].tolist() == [0, 0]
    assert counts[2] / counts.sum() == pytest.approx(0.75, abs=5 * np.sqrt(0.75 * 0.25 / 10_000))
    assert np.array_equal(order.batch(5), Order(4, weights, 50, seed=1).batch(5))
