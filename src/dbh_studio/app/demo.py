"""The demo plot: made by the program itself, once, and kept in the cache."""

from __future__ import annotations

import contextlib
import csv
import datetime
import hashlib
import io
import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dbh_studio.app.cache import CACHE_VARIABLE, cache_folder
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.synthetic import GENERATOR_VERSION, PlotRecipe, TreeTruth, make_plot
from dbh_studio.errors import FileError, MalformedFileError, MissingComponentError, ProjectLockedError, SettingError
from dbh_studio.io.lock import lock_file

_PLOT_NAME, _TRUTH_NAME, _MANIFEST_NAME = "demo_plot_synthetic.laz", "demo_plot_truth.csv", "complete.json"
# Half a millimetre: well below the noise, and a quarter smaller than a tenth of one.
_LAZ_STEP_M = 0.0005
_WORKSHOP, _LOCK = ".demo-", ".lock"
# Younger than this a lock nobody holds may be one that is just being taken; a workshop without one is a day's leftover.
_SETTLED_S, _ABANDONED_S = 60.0, 86_400.0
_NOTE = "Synthetic forest plot made by DBH Studio; no such forest exists. Metres, z up, no coordinate reference system."


@dataclass(frozen=True)
class DemoPlot:
    """Where the demo plot lies.

    Attributes:
        path: The LAZ file, in metres, z up, coloured. It does not say which point belongs to which tree.
        truth_csv: What is true of every stem; columns as in `truth_table`.
    """

    path: Path
    truth_csv: Path


def demo_recipe() -> PlotRecipe:
    """The recipe that ships with the program.

    Raises:
        MissingComponentError: The file is not where the program was installed.
        MalformedFileError: Somebody has edited it, and it is no longer a recipe.
    """
    package = Path(__file__).resolve().parents[1]
    for assets in (package / "assets", package.parents[1] / "assets"):
        path = assets / "demo_plot.json"
        if path.is_file():
            try:
                return PlotRecipe.from_dict(json.loads(path.read_text(encoding="utf-8"))["recipe"])
            except (ValueError, KeyError, TypeError, SettingError) as error:
                raise MalformedFileError(path, f"This is not a plot recipe ({error}).", "Install again.") from error
    raise MissingComponentError("The recipe of the demo plot (demo_plot.json) is missing.", "Install DBH Studio again.")


def demo_plot(
    cache_dir: Path | None = None, *, recipe: PlotRecipe | None = None, progress: Progress = ignore_progress
) -> DemoPlot:
    """The demo plot, made now if it is not in the cache yet.

    Another recipe or another version of the generator makes another plot. Two processes may ask at once: both get a
    whole plot.

    Args:
        cache_dir: Where to keep it; see `cache_folder`.
        recipe: In place of the one that ships with the program.
        progress: Called while the plot is made.

    Raises:
        FileError: The cache cannot be written.
    """
    recipe = demo_recipe() if recipe is None else recipe
    cache = cache_folder(cache_dir)
    folder = cache / f"demo-{_fingerprint(recipe)}"
    _clear_leftovers(cache)
    if not _is_complete(folder):
        try:
            _make(folder, recipe, progress)
        except OSError as error:
            reason = error.strerror or str(error)
            raise FileError(
                folder, f"The demo plot cannot be kept here: {reason}.", f"Set {CACHE_VARIABLE} to a folder with room."
            ) from error
    progress(1.0, "The demo plot is ready.")
    return DemoPlot(folder / _PLOT_NAME, folder / _TRUTH_NAME)


def _fingerprint(recipe: PlotRecipe) -> str:
    described = json.dumps({"recipe": recipe.to_dict(), "version": GENERATOR_VERSION}, sort_keys=True)
    return hashlib.sha256(described.encode()).hexdigest()[:12]


def _is_complete(folder: Path) -> bool:
    """Whether both files are there at the size they were written with."""
    try:
        sizes = json.loads((folder / _MANIFEST_NAME).read_text(encoding="utf-8"))
        return all((folder / name).stat().st_size == sizes[name] for name in (_PLOT_NAME, _TRUTH_NAME))
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _make(folder: Path, recipe: PlotRecipe, progress: Progress) -> None:
    """Make the plot in a folder of its own and move that into place as a whole."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with _workshop(folder.parent) as workshop:
        plot = make_plot(recipe, progress=subprogress(progress, 0.0, 0.8))
        progress(0.8, "Saving the demo plot.")
        write_laz(workshop / _PLOT_NAME, plot.cloud)
        (workshop / _TRUTH_NAME).write_bytes(truth_table(plot.trees).encode())
        sizes = {name: (workshop / name).stat().st_size for name in (_PLOT_NAME, _TRUTH_NAME)}
        (workshop / _MANIFEST_NAME).write_text(json.dumps(sizes), encoding="utf-8")
        # A temporary folder is its maker's alone; the cache may be shared.
        workshop.chmod(0o755)
        _move_into_place(workshop, folder)


@contextlib.contextmanager
def _workshop(cache: Path) -> Iterator[Path]:
    """A folder to work in, gone afterwards; the system's lock on the file beside it says that its maker is alive."""
    workshop = Path(tempfile.mkdtemp(prefix=_WORKSHOP, dir=cache))
    lock_path = Path(f"{workshop}{_LOCK}")
    try:
        with contextlib.ExitStack() as held:
            with contextlib.suppress(OSError):  # a file system without locks: nobody will clear up, nobody is harmed
                held.enter_context(lock_file(lock_path))
            yield workshop
    finally:
        shutil.rmtree(workshop, ignore_errors=True)
        lock_path.unlink(missing_ok=True)


def _clear_leftovers(cache: Path) -> None:
    """Remove the workshops of processes that were killed, and no others."""
    for path in list(cache.glob(f"{_WORKSHOP}*")):
        with contextlib.suppress(OSError, ProjectLockedError):
            age_s = time.time() - path.stat().st_mtime
            if path.suffix == _LOCK and age_s > _SETTLED_S:
                lock_file(path).close()  # raises where its maker lives
                shutil.rmtree(path.with_suffix(""), ignore_errors=True)
                path.unlink(missing_ok=True)
            elif path.is_dir() and age_s > _ABANDONED_S and not Path(f"{path}{_LOCK}").exists():
                shutil.rmtree(path, ignore_errors=True)


def _move_into_place(workshop: Path, folder: Path) -> None:
    """Rename; where another process was first, keep what it made, for it is the same."""
    if folder.exists() and not _is_complete(folder):
        shutil.rmtree(folder, ignore_errors=True)
    try:
        # A folder may not be replaced by a full one, which is what makes this safe against a second process.
        workshop.rename(folder)
    except OSError:
        if not _is_complete(folder):
            raise


def write_laz(path: Path, cloud: PointCloud) -> None:
    """Write a synthetic cloud as LAZ 1.2 in metres; the header says what it is. The same cloud gives the same bytes."""
    import laspy

    header = laspy.LasHeader(point_format=2, version="1.2")
    header.scales = np.full(3, _LAZ_STEP_M)
    header.offsets = np.asarray(cloud.origin)
    header.system_identifier = "SYNTHETIC"
    header.generating_software = "DBH Studio plot generator"
    # A fixed day, so that the same recipe gives the same file on any day.
    header.creation_date = datetime.date(2000, 1, 1)
    header.vlrs.append(laspy.VLR("LASF_Spec", 3, "Text area description", _NOTE.encode()))
    las = laspy.LasData(header)
    for axis, name in enumerate("XYZ"):
        las[name] = np.round(cloud.xyz[:, axis].astype(np.float64) / _LAZ_STEP_M).astype(np.int32)
    if cloud.rgb is not None:
        las.red, las.green, las.blue = (cloud.rgb.astype(np.uint16) * 257).T
    with path.open("wb") as file:
        las.write(file, do_compress=True)
        file.flush()
        os.fsync(file.fileno())


def truth_table(trees: tuple[TreeTruth, ...]) -> str:
    """What is true of every stem as CSV, one row per stem; diameters at 1.30 m and, as ``…_137``, at 1.37 m."""
    definitions = ("tape", "curve", "area")
    names = ["tree_id", "species", "status", "x_m", "y_m", "z_ground_m", "height_m", "lean_deg", "lean_azimuth_deg"]
    names += [f"dbh_{definition}_cm" for definition in definitions]
    names += [f"dbh_{definition}_137_cm" for definition in definitions]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*names, "seen_arc_deg", "n_points", "n_points_band"])
    for tree in trees:
        place = [f"{value:.3f}" for value in (tree.x_m, tree.y_m, tree.z_ground_m, tree.height_m)]
        lean = [f"{tree.lean_deg:.2f}", f"{tree.lean_azimuth_deg:.1f}"]
        diameters = [f"{tree.diameter_cm(name, height_m=h):.3f}" for h in (1.3, 1.37) for name in definitions]
        row = [str(tree.tree_id), tree.species, tree.status, *place, *lean, *diameters]
        writer.writerow([*row, f"{tree.seen_arc_deg:.0f}", str(tree.n_points), str(tree.n_points_band)])
    return text.getvalue()
