import numpy as np
import pytest
from PIL import Image

from ilnet.commands import pictures


def test_pictures_of_a_town(tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "_ABOVE", (120, 90))
    monkeypatch.setattr(pictures, "_STREET", (120, 60))
    files = pictures.draw(["town07"], tmp_path / "new")
    assert {f.name for f in files} == {
        "town07_above.jpg",
        "town07_street.jpg",
        "range_images.png",
        "points.png",
        "towns.png",
    }
    for file in files:
        assert np.asarray(Image.open(file).convert("L")).std() > 5  # The picture is not empty.


def test_unknown_town_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match=r"^name is 'nowhere'"):
        pictures.draw(["nowhere"], tmp_path / "new")
    assert not (tmp_path / "new").exists()
