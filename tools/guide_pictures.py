#!/usr/bin/env python3
"""Make the pictures of the guide again: the studio in a browser without a window, on the demo plot and one with photos.

    .venv/bin/python tools/guide_pictures.py                     # all of them
    .venv/bin/python tools/guide_pictures.py inspect export      # some

Needs what the browser tests need. Takes some minutes where the browser draws in software.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageColor

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests" / "ui"), str(ROOT)]

import browser  # noqa: E402
import mask_plots  # noqa: E402
import scale_plots  # noqa: E402

from dbh_studio.app.commands import change_settings, correct_measurement  # noqa: E402
from dbh_studio.app.demo import demo_plot  # noqa: E402
from dbh_studio.app.doctor import find_chromium  # noqa: E402
from dbh_studio.core.cloud import PointCloud  # noqa: E402
from dbh_studio.core.corrections import Correction  # noqa: E402
from dbh_studio.core.dbh import DbhEstimate  # noqa: E402
from dbh_studio.io.ply import write_ply  # noqa: E402
from dbh_studio.io.reader import read_reconstruction  # noqa: E402
from dbh_studio.ui.server import start_server  # noqa: E402
from dbh_studio.ui.studio import Studio  # noqa: E402

SIZE = (1440, 900)
LARGEST_BYTES = 250_000
PATIENCE_S = 300.0
PANEL = "the panel"
OF_SCALE = ("scale", "corners", "photos", "markers")
OF_MASKS = ("masks", "label-count")
OF_REVIEW = ("review", "draw-in-section", "describe")
OF_EDITING = ("edit-lasso", "edit-plane", "edit-slice", "edit-keys")
# White, the curves, the tape, the ring, the marks of good, fair, poor and refused, the bars of the hints.
KEPT = [ImageColor.getrgb(c) for c in (
    "#ffffff", "#1864ab", "#5f3dc4", "#d9480f", "#0b7285", "#a61e8c", "#e8590c", "#143cbe", "#2b8a3e",
    "#e8890c", "#c92a2a", "#868e96", "#f59f00",
    "#e03131", "#37b24d", "#1c7ed6", "#ebfbee", "#fff9db", "#fff5f5", "#e7f5ff", "#fff3bf", "#40c057", "#212529",
)]  # fmt: skip


class Photographer:
    """Drives the studio like a person and keeps what is on the screen."""

    def __init__(self, studio: Studio, page: Any, out: Path, wanted: list[str]) -> None:
        self.studio, self.page, self.out, self.wanted = studio, page, out, wanted

    def settle(self, seconds: float = 3.0) -> None:
        """Wait for the studio, and for the drawing after it."""
        if not self.studio.wait_idle(PATIENCE_S):
            raise SystemExit("The studio did not come to rest.")
        self.page.wait_for_timeout(1000 * seconds)
        browser.close_notifications(self.page)

    def take(self, name: str, clip: str = "") -> None:
        """Save the window, or one element of it, small enough for a repository."""
        if self.wanted and name not in self.wanted:
            return
        area = None
        if clip == PANEL:
            left = self.page.locator(".dbh-steps").bounding_box()["x"] - 10
            area = {"x": left, "y": 0, "width": SIZE[0] - left, "height": 760}
        elif clip:
            area = self.page.locator(clip).first.bounding_box()
        shot = self.page.screenshot(clip=area, timeout=120_000)
        image = Image.open(io.BytesIO(shot)).convert("RGB")
        path = self.out / f"{name}.png"
        path.write_bytes(smallest(image))
        print(f"{path.name}: {path.stat().st_size // 1000} kB")

    def open(self, path: Path) -> None:
        self.studio.open_plot(path)
        self.page.wait_for_timeout(500)
        self.settle()
        assert self.studio.display is not None
        browser.wait_for_points(self.page, int((~self.studio.display.is_crown).sum()))
        self.settle(1.0)

    def until(self, condition: Callable[[], Any]) -> Any:
        """Ask again and again until the answer is true."""
        deadline = time.monotonic() + PATIENCE_S
        while not (answer := condition()):
            if time.monotonic() > deadline:
                raise SystemExit("What the picture is to show did not come to pass.")
            time.sleep(0.1)
        return answer

    @property
    def tab(self) -> Any:
        """The page, as the studio knows it."""
        (tab,) = self.studio._tabs.values()
        return tab

    def look_at(self, target: np.ndarray, away: np.ndarray) -> None:
        """Look at a place of the cloud from another one."""
        tab = self.tab
        tab.worker.post(lambda: tab.scene._move(target + away, target, animate=False))
        self.until(lambda: np.linalg.norm(np.asarray(tab.client.camera.position) - target - away) < 1e-3)
        self.settle(1.0)

    def step(self, name: str) -> None:
        self.page.click(f"button[data-step={name}]")
        self.settle(1.5)

    def choose(self, tree_id: int) -> None:
        self.page.click(f"tr[data-id='{tree_id}']")
        self.settle()

    def show_path(self, text: str) -> None:
        """A path as a reader would type it, in place of the one on this computer."""
        self.show_text("File or folder", text)

    def show_text(self, label: str, text: str) -> None:
        """Type into a field of the panel."""
        field = f"//label[normalize-space()='{label}']/ancestor::div[contains(@class,'mantine-Flex-root')][1]"
        self.page.locator(f"{field}//input").first.fill(text)


def smallest(image: Image.Image) -> bytes:
    """PNG with as many colours as fit: points need few, the panel keeps its own, and what means something its hue."""
    panel = image.crop((int(0.73 * image.width), 0, image.width, image.height))
    own = panel.quantize(64, dither=Image.Dither.NONE).getpalette()[: 3 * 64]
    for colours in (128, 96, 64, 40, 24, 16, 10):
        scene = image.quantize(colours, dither=Image.Dither.NONE).getpalette()[: 3 * colours]
        palette = Image.new("P", (1, 1))
        palette.putpalette([*np.ravel(KEPT).tolist(), *own, *scene])
        content = io.BytesIO()
        image.quantize(palette=palette, dither=Image.Dither.NONE).save(content, "PNG", optimize=True)
        if content.tell() <= LARGEST_BYTES:
            return content.getvalue()
    raise SystemExit(f"A picture stays above {LARGEST_BYTES} bytes.")


def unscaled(demo: Path, folder: Path) -> Path:
    """The demo plot as photogrammetry would leave it: no unit, y up."""
    cloud = read_reconstruction(demo).cloud
    xyz = (cloud.xyz[::4] / 1.7)[:, [0, 2, 1]] * np.array([1, 1, -1], np.float32)
    path = folder / "from_video.ply"
    write_ply(path, PointCloud(xyz.astype(np.float32), np.zeros(3), None if cloud.rgb is None else cloud.rgb[::4]))
    return path


def of_scale(camera: Photographer, folder: Path) -> None:
    """The ways to a scale, on a plot with two markers and the photos it was made from."""
    page, studio = camera.page, camera.studio
    # Denser than a test needs.
    scale_plots._N_GROUND, scale_plots._N_STEMS = 60_000, 40_000
    plots = folder / "plots"
    plots.mkdir()
    cloud = scale_plots.write_plot(plots)
    camera.open(cloud)
    camera.step("scale")
    found = page.get_by_role("button", name="Show them", exact=True)
    found.wait_for()
    corners = scale_plots.plot().corners()
    middle, side = corners.mean(axis=0), float(np.linalg.norm(corners[1] - corners[0]))
    away = side * np.array([1.6, -7.5, 4.5])
    camera.look_at(middle, away)
    camera.take("scale")
    found.click()
    camera.until(lambda: studio.session is not None and studio.session.cameras is not None)
    camera.settle()
    clicked_corners(camera, corners, side)
    camera.look_at(middle, away)
    clicked_in_photos(camera, corners)
    page.click("button[data-way=markers]")
    page.get_by_role("button", name="Find markers in the photos", exact=True).click()
    camera.until(lambda: studio.session is not None and studio.session.document.scale.is_known)
    camera.settle()
    page.locator(".dbh-markrow:has(button[data-do=use]) input").fill("0.50")
    page.click("button[data-do=use]")
    camera.until(lambda: studio.session is not None and len(studio.session.document.evidence) == 2)
    camera.settle()
    page.locator(".dbh-length .dbh-name").first.click()
    scale = studio.session.document.scale.metres_per_unit if studio.session is not None else 1.0
    camera.look_at(scale * middle, scale * away)
    camera.take("markers")


def clicked_corners(camera: Photographer, corners: np.ndarray, side: float) -> None:
    """The corners of a marker in the cloud, with the close-up."""
    page = camera.page
    page.click("button[data-way=cloud]")
    page.click("button[data-start=square]")
    page.wait_for_selector("#dbh-banner")
    camera.look_at(corners.mean(axis=0), side * np.array([0.1, -1.2, 2.4]))
    for number, corner in enumerate(corners[:3]):
        page.mouse.click(*browser.pixel_of(page, corner))
        page.wait_for_selector(f"button[data-point='{number}'][data-kind=done]")
    camera.settle()
    camera.take("corners")
    page.click(".dbh-markhead button[data-do=stop]")
    camera.settle(1.0)


def clicked_in_photos(camera: Photographer, corners: np.ndarray) -> None:
    """A corner in one photo, its line of sight, and the photos offered next."""
    page, tab = camera.page, camera.tab
    page.click("button[data-way=photos]")
    page.click("button[data-start=bar]")
    page.click(".dbh-marking button[data-do=photo]")
    camera.until(lambda: tab.photos.image is not None)
    click_in_photo(camera, corners[0])
    page.locator(".dbh-offers button").first.click()
    camera.settle()
    click_in_photo(camera, corners[0])
    camera.settle()
    camera.take("photos")
    page.click(".dbh-markhead button[data-do=stop]")
    page.click("#dbh-photo [data-photo=close]")
    camera.settle(1.0)


def click_in_photo(camera: Photographer, point: np.ndarray) -> None:
    """Turn the open photo to a point of the cloud, and click it there."""
    page, tab = camera.page, camera.tab
    name = tab.photos.image
    uv = scale_plots.plot().posed.by_name(name).project(point[None])[0][0]
    tab.worker.post(lambda: tab.photos.open(name, at_px=(float(uv[0]), float(uv[1])), zoom_px=3.0))
    camera.settle()
    (x, y), _ = (np.asarray(part)[0] for part in tab.photos._look.view_from_photo([uv]))
    box = page.locator("#dbh-photo .view").bounding_box()
    look = tab.photos._look
    page.mouse.click(box["x"] + x / look.width_px * box["width"], box["y"] + y / look.height_px * box["height"])
    camera.settle(1.0)


def of_masks(camera: Photographer, folder: Path) -> None:
    """Masks that were brought, one of them being painted, and what they say of the cloud."""
    page, studio = camera.page, camera.studio
    plot = mask_plots.write_forest(folder / "masks_plot")
    studio.adopt(mask_plots.open_session(plot, folder / "masks_plot.dbh"))
    camera.settle()
    camera.step("trunks")
    page.get_by_text("Bring masks").first.click()
    camera.show_text("Masks in", str(plot.masks))
    page.get_by_role("button", name="Look at them", exact=True).click()
    page.get_by_role("button", name="Use these masks", exact=True).click()
    page.get_by_role("button", name="Look through the masks", exact=True).click()
    page.wait_for_selector("#dbh-photo .view[data-frame]")
    page.click("[data-photo=large]")
    camera.settle()
    tab, name = camera.tab, "01.jpg"
    tab.worker.post(lambda: tab.photos.open(name, at_px=(400.0, 256.0), zoom_px=4.0))
    camera.settle()
    page.click("[data-mask=paint]")
    page.click("[data-mask=erase]")
    page.locator("[data-mask=size]").fill("26")
    (x, y), _ = (np.asarray(part)[0] for part in tab.photos._look.view_from_photo([(324.0, 250.0)]))
    box = page.locator("#dbh-photo .view").bounding_box()
    page.mouse.move(box["x"] + x, box["y"] + y - 60)
    page.mouse.down()
    page.mouse.move(box["x"] + x, box["y"] + y, steps=12)
    page.mouse.up()
    camera.settle()
    camera.show_text("Masks in", "plots/masks")
    page.mouse.move(box["x"] + x, box["y"] + y)
    camera.take("masks")
    page.click("[data-mask=done]")
    page.click("[data-photo=close]")
    page.get_by_role("button", name="Find trunks from the masks", exact=True).click()
    camera.until(lambda: studio.session is not None and len(studio.session.document.trunks))
    camera.settle()
    page.click("#dbh-view button[data-mode='Label count']")
    camera.settle(5.0)
    camera.take("label-count")


def tour(camera: Photographer, folder: Path) -> None:
    """The way of one plot from opening to export, as the guide tells it."""
    page, studio = camera.page, camera.studio
    demo = folder / "demo_plot.laz"
    shutil.copyfile(demo_plot().path, demo)
    if not camera.wanted or set(camera.wanted) & set(OF_SCALE):
        of_scale(camera, folder)
    if not camera.wanted or set(camera.wanted) & set(OF_MASKS):
        of_masks(camera, folder)
    if camera.wanted and set(camera.wanted) <= {*OF_SCALE, *OF_MASKS}:
        return
    if not camera.wanted or "data-check-unscaled" in camera.wanted:
        camera.open(unscaled(demo, folder))
        camera.step("open")
        camera.show_path("plots/from_video.ply")
        camera.take("data-check-unscaled", clip=PANEL)
    camera.open(demo)
    camera.step("open")
    camera.show_path("plots/demo_plot.laz")
    camera.take("open")
    camera.step("trunks")
    page.get_by_role("button", name="Find trunks", exact=True).click()
    page.wait_for_function("() => parseFloat(document.querySelector('.dbh-bar div')?.style.width) > 30")
    camera.take("finding")
    camera.settle(5.0)
    camera.take("trunks")
    assert studio.session is not None
    results = {i: studio.session.measurement(i).result for i in studio.session.document.trunks.ids}
    good = [i for i, r in results.items() if isinstance(r, DbhEstimate) and r.quality == "good"]
    partly = [i for i, r in results.items() if isinstance(r, DbhEstimate) and r.quality == "poor"]
    camera.choose(good[len(good) // 2])
    camera.take("inspect")
    camera.take("card", clip=".dbh-card")
    if partly:
        camera.choose(partly[0])
        camera.take("poor")
    if not camera.wanted or set(camera.wanted) & set(OF_REVIEW):
        of_review(camera, good)
    no_diameter(camera)
    page.click("#dbh-view button[data-look=plot]")
    page.click("#dbh-view button[data-mode='Segmentation (by tree)']")
    camera.step("export")
    camera.take("export")
    if not camera.wanted or set(camera.wanted) & set(OF_EDITING):
        of_editing(camera, good[0])
    if not camera.wanted or "steps" in camera.wanted:
        lost_trees(camera)


def of_review(camera: Photographer, good: list[int]) -> None:
    """Trees looked through, one corrected since, points drawn round in a section, three described at once; undone."""
    page, session = camera.page, camera.studio.session
    assert session is not None and session.saver is not None
    before, author = session.document, session.saver._author
    session.saver._author = ""  # of whoever makes the pictures
    camera.choose(good[0])
    for _ in range(3):
        page.keyboard.press("Space")
        camera.settle(1.0)
    session.do(correct_measurement(good[0], Correction("tape", round(session.measurement(good[0]).result.dbh_cm, 1))))
    session.do(correct_measurement(good[0], Correction("breast_height", 1.8, why="branch stub")))
    camera.choose(good[0])
    camera.take("review")
    page.click("button[data-draw=out]")
    box = page.locator(".dbh-section").bounding_box()
    page.mouse.move(box["x"] + 0.72 * box["width"], box["y"] + 0.1 * box["height"])
    page.mouse.down()
    for x, y in ((0.95, 0.3), (0.96, 0.65), (0.8, 0.62), (0.7, 0.3)):
        page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"], steps=6)
    camera.take("draw-in-section", clip=".dbh-card")
    page.keyboard.press("Escape")
    page.mouse.up()
    page.click(f"tr[data-id='{good[1]}']")
    page.click(f"tr[data-id='{good[3]}']", modifiers=["Shift"])
    page.get_by_text("About this tree").click()
    camera.show_text("Species", "oak")
    page.get_by_role("button", name="Keep", exact=True).scroll_into_view_if_needed()
    camera.settle(1.0)
    camera.take("describe", clip=PANEL)
    camera.show_text("Species", "")
    page.get_by_text("About this tree").click()
    camera.settle(1.0)
    while session.document is not before:
        session.undo()
    session.saver._author = author
    camera.settle()


def of_editing(camera: Photographer, tree: int) -> None:
    """Points about a trunk under the lasso, a cut by a plane, a slice from above, the keys; nothing is changed."""
    page, session = camera.page, camera.studio.session
    assert session is not None
    stem = session.measurement(tree)
    target = np.array([*stem.xy_m, stem.z_ground_m + 1.3])
    camera.step("inspect")
    page.click("#dbh-view button[data-mode='Segmentation (red)']")
    camera.choose(tree)
    page.get_by_role("button", name=f"Correct tree {tree}").click()
    page.wait_for_selector("#dbh-edit .chosen")
    camera.look_at(target, np.array([0.4, -3.2, 0.5]))
    page.click("#dbh-edit button[data-edit=tool-lasso]")
    camera.settle()
    x, y = browser.pixel_of(page, target)
    page.mouse.move(x, y - 90)
    page.mouse.down()
    for off in ((100, -90), (120, 0), (100, 90), (0, 90), (0, -80)):
        page.mouse.move(x + off[0], y + off[1], steps=8)
    page.mouse.up()
    camera.until(lambda: len(camera.tab.editing.points))
    camera.settle(8.0)
    camera.take("edit-lasso")
    page.click("#dbh-edit button[data-edit=tool-plane]")
    camera.settle(8.0)
    camera.take("edit-plane")
    page.click("#dbh-edit button[data-edit=tool-click]")
    page.click("#dbh-edit input[data-edit=slice]")
    page.click("#dbh-edit button[data-edit=above]")
    camera.settle(8.0)
    camera.take("edit-slice")
    page.click("#dbh-edit button[data-edit=keys]")
    camera.settle(8.0)
    camera.take("edit-keys", clip="#dbh-edit")
    page.click("#dbh-edit button[data-edit=keys]")
    page.click("#dbh-edit button[data-edit=close]")
    camera.settle()


def no_diameter(camera: Photographer) -> None:
    """A tree that is refused; where none is, one that a curve of the paper refuses."""
    session = camera.studio.session
    assert session is not None
    if camera.wanted and "refused" not in camera.wanted:
        return
    own = session.document.settings.measure.curve
    for curve in (own, "fourier"):
        session.do(change_settings("measure", curve=curve))
        camera.settle()
        refused = [i for i in session.document.trunks.ids if not session.measurement(i).result]
        if refused:
            camera.choose(refused[0])
            camera.take("refused")
            break
    session.do(change_settings("measure", curve=own))
    camera.settle()


def lost_trees(camera: Photographer) -> None:
    """What the paper's rule loses, in the colours of the steps."""
    page, session = camera.page, camera.studio.session
    assert session is not None
    session.do(change_settings("trunks", small_clusters="otsu"))
    camera.step("trunks")
    page.get_by_role("button", name="Find trunks", exact=True).click()
    camera.until(lambda: session.last_search and session.last_search.steps.settings.small_clusters == "otsu")
    camera.settle()
    page.click("#dbh-view button[data-mode=Steps]")
    page.get_by_text("Where trees were lost").click()
    page.locator("[data-go]").first.click()
    camera.settle(5.0)
    camera.take("steps")


@contextlib.contextmanager
def photographer(folder: Path, out: Path, wanted: list[str], display_points: int) -> Iterator[Photographer]:
    chromium_path = find_chromium()
    if chromium_path is None:
        raise SystemExit("No Chromium was found; 'make test' installs it, or says how.")
    studio = Studio(start_server(port=0), uploads_folder=folder / "uploads", display_points=display_points)
    try:
        with browser.chromium(chromium_path) as chromium:
            page = browser.open_page(chromium, studio.server.url + "&fixedDpr=1", size=SIZE)
            page.wait_for_selector(".dbh-steps")
            camera = Photographer(studio, page, out, wanted)
            camera.settle()
            yield camera
            errors = browser.page_errors(page)
            if errors:
                raise SystemExit("\n".join(["The page complained:", *errors]))
    finally:
        studio.close()


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Make the pictures of the guide.")
    parser.add_argument("names", nargs="*", help="which pictures; all by default")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "guide" / "pictures")
    parser.add_argument("--display-points", type=int, default=700_000)
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with photographer(folder, options.out, options.names, options.display_points) as camera:
            tour(camera, folder)


if __name__ == "__main__":
    main()
