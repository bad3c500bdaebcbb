"""README's pictures show the present model: their metadata say what they were drawn from."""

import re
import sys
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))

import pictures  # noqa: E402

from sweep.analysis.canvas import PNG_SOURCE_FIELD  # noqa: E402


@pytest.mark.parametrize("picture", pictures.PICTURES, ids=lambda picture: picture.file)
def test_a_picture_is_of_the_present_model_and_study(picture):
    assert pictures.is_current(picture), "draw them anew: make pictures"


def test_every_picture_of_readme_is_one_that_the_command_draws():
    shown_pictures = re.findall(r"!\[[^]]*\]\(docs/([^)]+)\)", (ROOT / "README.md").read_text())
    assert shown_pictures and set(shown_pictures) <= {picture.file for picture in pictures.PICTURES}


@pytest.mark.parametrize("change", ["model", "study", "figure", "none", "gone"])
def test_a_picture_of_anything_else_is_out_of_date(change, tmp_path, monkeypatch):
    picture = pictures.PICTURES[0]
    monkeypatch.setattr(pictures, "DOCS", tmp_path)
    monkeypatch.setattr(pictures, "EXPERIMENTS", tmp_path)
    spec = (ROOT / "experiments" / "quickstart.yaml").read_text()
    (tmp_path / "quickstart.yaml").write_text(spec)
    if change != "gone":
        with Image.open(ROOT / "docs" / picture.file) as image:
            assert re.fullmatch(
                r"study [0-9a-f]{32}, figure [0-9a-f]{16}", image.info[PNG_SOURCE_FIELD]
            )
            if change == "none":
                image.info.clear()
                image.save(tmp_path / picture.file)
            else:
                (tmp_path / picture.file).write_bytes((ROOT / "docs" / picture.file).read_bytes())
                assert pictures.is_current(picture)
    if change == "model":
        monkeypatch.setattr("sweep.spec.specs.MODEL_VERSION", "another")
    elif change == "study":
        (tmp_path / "quickstart.yaml").write_text(spec.replace("[0.1 W,", "[0.2 W,"))
    elif change == "figure":
        changed_spec = spec.replace(
            "levels: [0.5, 0.9], title: Where", "levels: [0.9], title: Where"
        )
        assert changed_spec != spec
        (tmp_path / "quickstart.yaml").write_text(changed_spec)
    assert not pictures.is_current(picture)
