"""The guide: its generated page is current, its pictures are there and small, its links lead somewhere."""

import importlib.util
import re
from pathlib import Path

import pytest
import scale_plots
from PIL import Image

import dbh_studio
from dbh_studio.settings import Settings

ROOT = Path(__file__).parents[2]
GUIDE = ROOT / "docs" / "guide"
PAGES = sorted(GUIDE.glob("*.md"))
LINKING = (*PAGES, *sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md", ROOT / "bench" / "README.md")


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


def anchors(page):
    """What a link may name in a page: its headings, as they are shown by code hosts."""
    headings = re.findall(r"^#+ (.*)", page.read_text(encoding="utf-8"), flags=re.M)
    return {re.sub(r"[^\w -]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", LINKING, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_pictures_lead_somewhere(page):
    text = page.read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'src="([^"]+)"', text)
    local = [target.split("#")[0] for target in targets if "://" not in target]
    missing = [target for target in local if target and not (page.parent / target).exists()]
    assert missing == []
    deep = [target.split("#") for target in targets if "://" not in target and "#" in target]
    lost = [
        (path, anchor)
        for path, anchor in deep
        if (page.parent / path if path else page).suffix == ".md"
        and anchor not in anchors(page.parent / path if path else page)
    ]
    assert lost == []


def test_every_picture_is_made_by_the_tool():
    made = re.findall(r'camera\.take\("([\w-]+)"', (ROOT / "tools" / "guide_pictures.py").read_text(encoding="utf-8"))
    assert sorted(made) == sorted(picture.stem for picture in (GUIDE / "pictures").iterdir())


def test_the_example_with_photos_runs_as_written(tmp_path, monkeypatch, capsys):
    """The other examples of the page are run by `test_api`; this one needs photos."""
    scale_plots.write_plot(tmp_path)
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```py\n(.*?)```", (GUIDE / "python.md").read_text(encoding="utf-8"), re.DOTALL)
    names = {"dbh_studio": dbh_studio}
    exec(compile(code, "python.md", "exec"), names)
    scale = names["plot"].session.document.scale
    assert scale.source == "marker"
    assert scale.metres_per_unit == pytest.approx(scale_plots.plot().metres_per_unit, rel=0.003)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in lines[1:]] == ["7", "13"]


def test_every_picture_is_shown_somewhere_and_small():
    texts = "".join(page.read_text(encoding="utf-8") for page in (*PAGES, ROOT / "README.md"))
    pictures = sorted((GUIDE / "pictures").iterdir())
    assert pictures
    for picture in pictures:
        assert f"pictures/{picture.name}" in texts
        assert picture.stat().st_size <= 250_000
        with Image.open(picture) as image:
            assert min(image.size) > 200
