"""The guide: its generated page is current, its pictures are there and small, its links lead somewhere."""

import importlib.util
import re
from pathlib import Path

import pytest
from PIL import Image

from dbh_studio.settings import Settings

ROOT = Path(__file__).parents[2]
GUIDE = ROOT / "docs" / "guide"
PAGES = sorted(GUIDE.glob("*.md"))


def tool(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_of_settings_is_current():
    assert tool("guide_settings").page() == (GUIDE / "settings.md").read_text(encoding="utf-8"), (
        "run tools/guide_settings.py"
    )


def test_the_page_of_settings_has_every_setting_once():
    page = (GUIDE / "settings.md").read_text(encoding="utf-8")
    sections = dict(re.findall(r"^## (\w+):[^\n]*\n(.*?)(?=^## |\Z)", page, flags=re.S | re.M))
    for section, values in Settings():
        found = re.findall(r"^\| [^|]+ \| `(\w+)` \|", sections[section.capitalize()], flags=re.M)
        assert found == list(type(values).model_fields)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_pictures_lead_somewhere(page):
    text = page.read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'src="([^"]+)"', text)
    local = [target.split("#")[0] for target in targets if "://" not in target]
    missing = [target for target in local if target and not (page.parent / target).exists()]
    assert missing == []


def test_every_picture_is_shown_somewhere_and_small():
    texts = "".join(page.read_text(encoding="utf-8") for page in (*PAGES, ROOT / "README.md"))
    pictures = sorted((GUIDE / "pictures").iterdir())
    assert pictures
    for picture in pictures:
        assert f"pictures/{picture.name}" in texts
        assert picture.stat().st_size <= 300_000
        with Image.open(picture) as image:
            assert min(image.size) > 200
