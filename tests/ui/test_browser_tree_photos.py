"""The photographs of a tree in a real Chromium: a trunk is chosen, its pictures come, one is enlarged."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import browser
import mask_plots
import numpy as np
import pytest
from PIL import Image
from tests.treescene import is_brown, write_plot

from dbh_studio.app import commands
from dbh_studio.core.trunks import TrunkSet
from dbh_studio.ui.server import start_server
from dbh_studio.ui.studio import Studio

pytestmark = pytest.mark.browser

LAPTOP = (1366, 900)
N_GROUND, N_STEM = 30_000, 12_000
SHOWN = ".dbh-shots[data-state=shown][data-tree='%d']"


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    running = Studio(start_server(port=0), uploads_folder=tmp_path / "uploads", display_points=40_000)
    session = mask_plots.open_session(write_plot(tmp_path / "plot"), tmp_path / "plot.dbh")
    rows = [np.arange(N_GROUND + k * N_STEM, N_GROUND + (k + 1) * N_STEM) for k in range(3)]
    low = session.cloud.xyz[:N_GROUND, 2].min()
    stems = [each[session.cloud.xyz[each, 2] - low > 0.15] for each in rows]
    session.do(commands.replace_trunks(TrunkSet.from_point_sets(stems)))
    session.measurements()
    running.adopt(session)
    yield running
    running.close()


def test_a_chosen_trunk_is_shown_in_photographs(chromium: Any, studio: Studio) -> None:
    page = browser.open_page(chromium, studio.server.url + "&fixedDpr=1", size=LAPTOP)
    page.wait_for_selector(".dbh-steps")
    browser.close_notifications(page)
    page.click("button[data-step=inspect]")
    page.click("tr[data-id='3']")
    page.wait_for_selector("[data-tree='3'][data-dbh]")
    page.wait_for_selector(SHOWN % 3)
    count = page.locator(".dbh-shots img").count()
    assert 2 <= count <= 4
    loaded = "() => [...document.querySelectorAll('.dbh-shots img')].every(i => i.complete && i.naturalWidth === 480)"
    page.wait_for_function(loaded)

    # Enlarged, a picture is as wide as the panel, and the stem stands in the middle of it.
    first = page.locator("figure[data-shot='0'] .shot")
    small = first.bounding_box()["width"]
    first.click()
    wide = "w => document.querySelector('figure[data-shot=\"0\"] .shot').clientWidth > 1.6 * w"
    page.wait_for_function(wide, arg=small)
    first.scroll_into_view_if_needed()
    picture = np.asarray(Image.open(io.BytesIO(first.screenshot())).convert("RGB"))
    height, width = picture.shape[:2]
    brown = is_brown(picture)[height // 3 : 2 * height // 3]
    assert brown[:, int(0.45 * width) : int(0.55 * width)].mean() > 0.6
    assert brown[:, : int(0.2 * width)].mean() < 0.1

    # Closer: other pictures of the same tree.
    before = page.get_attribute("figure[data-shot='0'] img", "src")
    page.click("[data-do=tree-photo-closer]")
    page.wait_for_function(
        "src => {const i = document.querySelector('figure[data-shot=\"0\"] img'); return i && i.src !== src}",
        arg=before,
    )

    # And into the photo itself.
    page.locator("[data-do=tree-photo-open]").first.click()
    page.wait_for_selector("#dbh-photo .view[data-frame]")
    browser.settle(page, studio)
    (tab,) = studio._tabs.values()
    assert tab.photos.image is not None

    page.click("tr[data-id='1']")
    page.wait_for_selector(SHOWN % 1)
    assert browser.page_errors(page) == []
    page.context.close()
