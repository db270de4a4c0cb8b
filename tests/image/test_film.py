from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.errors import ImageError
from icheat_usd.image.film import Film


def test_layers_of_another_size_or_type_are_refused_by_name() -> None:
    with pytest.raises(ImageError, match="'depth'.*float64"):
        Film(3, 2, {"depth": np.zeros((2, 3))})  # type: ignore[dict-item]
    with pytest.raises(ImageError, match="'beauty'"):
        Film(3, 2, {"beauty": np.zeros((3, 2, 3), np.float32)})
    with pytest.raises(ImageError, match="frame"):
        Film(3, 2, {}, {"frame": 12})  # type: ignore[dict-item]
    with pytest.raises(ImageError, match="null character"):
        Film(3, 2, {}, {"stage": "a\0b"})
    with pytest.raises(ImageError, match="no pixels"):
        Film(0, 2, {})


def test_a_missing_layer_is_an_error_that_lists_those_there_are() -> None:
    film = Film(3, 2, {"direct": np.zeros((2, 3, 3), np.float32), "depth": np.zeros((2, 3), np.float32)})
    assert film.layer("depth").shape == (2, 3)
    with pytest.raises(ImageError, match="no layer 'beauty'; it has depth, direct"):
        film.layer("beauty")


def test_a_film_does_not_change_with_the_dictionary_it_was_made_from() -> None:
    layers = {"depth": np.zeros((2, 3), np.float32)}
    film = Film(3, 2, layers)
    layers.clear()
    assert list(film.layers) == ["depth"]
