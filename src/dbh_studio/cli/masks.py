"""`dbh-studio masks`: make masks of a plot's photos, list them, look at one, accept or reject it."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dbh_studio.cli.common import (
    add_cloud_options,
    add_relocation_option,
    counted,
    path_argument,
    plain,
    progress_for,
    unscaled_error,
)
from dbh_studio.cli.mask_options import add_making_options, make_request
from dbh_studio.errors import CommandError, FileError, ModelError, UnscaledCloudError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from dbh_studio.app.ladder import Ladder
    from dbh_studio.app.mask_making import MadeMasks, MakeRequest, MaskPlan
    from dbh_studio.app.plot_masks import MaskState
    from dbh_studio.app.session import Session
    from dbh_studio.core.posed_images import PosedImages
    from dbh_studio.io.masks import MaskStore

_REVIEWS = {"accept": "accepted", "reject": "rejected", "clear": ""}


def add_commands(commands: Any) -> None:
    """Register the commands."""
    masks = commands.add_parser(
        "masks",
        help="masks of a plot's photos that show its trunks: make, list, show, review",
        description="Masks of a plot's photos that show its trunks. They are kept beside the saved plot "
        "(NAME.dbh/masks); `dbh-studio run --masks stored` finds the trunks by them.",
    )
    actions = masks.add_subparsers(title="actions", metavar="ACTION", required=True)
    _add_make(actions)
    listing = actions.add_parser("list", help="each photo, its mask, and whether it votes")
    listing.add_argument("plot", type=path_argument, metavar="PLOT", help="a saved NAME.dbh, or a cloud")
    listing.set_defaults(command=list_masks)

    show = actions.add_parser("show", help="write one photo with its mask drawn over it")
    show.add_argument("plot", type=path_argument, metavar="PLOT", help="a saved NAME.dbh, or a cloud")
    show.add_argument("photo", metavar="PHOTO", help="its name, as `masks list` shows it")
    show.add_argument("picture", type=path_argument, metavar="OUT.jpg", help="the JPEG file to write")
    show.set_defaults(command=show_mask)

    review = actions.add_parser(
        "review",
        help="accept or reject the mask of a photo",
        description="Accept or reject masks. A rejected one does not vote when the trunks are found next.",
    )
    review.add_argument("plot", type=path_argument, metavar="PLOT", help="a saved NAME.dbh, or a cloud")
    review.add_argument("photos", nargs="+", metavar="PHOTO", help="names, as `masks list` shows them")
    review.add_argument("verdict", choices=tuple(_REVIEWS), help="clear takes back what was said")
    review.set_defaults(command=review_masks)
    for action in actions.choices.values():
        if action is not actions.choices["make"]:
            add_relocation_option(action)
            action.add_argument("--cameras", type=path_argument, metavar="PATH", help="poses of a cloud's photos")
            action.add_argument("--images", type=path_argument, metavar="DIR", help="folder of the photos")
        action.add_argument("--json", action="store_true", help="print JSON")
        action.add_argument("--verbose", action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)


def _add_make(actions: Any) -> None:
    make = actions.add_parser(
        "make",
        help="make masks with the trained models that are on this computer",
        description="Make masks of a plot's photos, one after the other, each kept as soon as it is done: stopped by "
        "Ctrl+C, a full disk or a power cut, the next run goes on with the photos that are left. Nothing is downloaded "
        "unless --fetch is given.",
    )
    make.add_argument(
        "plot", type=path_argument, metavar="PLOT", help="a saved NAME.dbh, or a cloud or folder that is not saved yet"
    )
    make.add_argument(
        "--cameras",
        type=path_argument,
        metavar="PATH",
        help="poses of the photos: a COLMAP model, Metashape XML, OpenSfM or ODM folder, or a table of poses; by "
        "default those of the saved plot, or what lies beside the cloud",
    )
    make.add_argument("--images", type=path_argument, metavar="DIR", help="folder of the photos, if not beside them")
    add_cloud_options(make)
    add_relocation_option(make)
    add_making_options(make)
    make.add_argument(
        "--photo", action="append", default=[], dest="photos", metavar="NAME", help="only this photo; several times"
    )
    make.add_argument("--redo", action="store_true", help="make masks anew that are there, but not painted ones")
    make.add_argument("--fetch", action="store_true", help="download the usual models first where they are missing")
    make.add_argument("--offline", action="store_true", help="download nothing, whatever else is given")
    make.add_argument("--dry-run", action="store_true", help="say which photos and how long; make nothing")
    make.add_argument("--quiet", action="store_true", help="no progress, no notes")
    make.set_defaults(command=make_masks)


# ---- making


def make_masks(options: argparse.Namespace) -> int:
    """Plan, say what it costs, and make."""
    from dbh_studio.app.ladder import look_at_ladder
    from dbh_studio.app.mask_making import plan_masks
    from dbh_studio.app.opening import open_plot
    from dbh_studio.app.photo_scale import PhotoRequest, add_photos
    from dbh_studio.io.models import ModelStore

    request = make_request(options)
    models = ModelStore(offline=True if options.offline else None)
    with progress_for(options) as progress:
        session = open_plot(
            options.plot,
            scale=options.scale,
            up=options.up,
            relocate=options.cloud,
            background_save=False,
            progress=progress,
        )
        try:
            try:
                session.require_scale()
            except UnscaledCloudError:
                raise unscaled_error() from None
            cameras = add_photos(session, PhotoRequest(options.cameras, options.images), progress=progress)
            if options.fetch:
                models.fetch(progress=progress)
            ladder = look_at_ladder(session, cameras=cameras, models=models, request=request)
            _check_can_make(ladder, request)
            plan = plan_masks(session, request, cameras=cameras, models=models, in_process=False, progress=progress)
            progress.finish()
            why = ladder["detector"].why_not if request.rung == "auto" else ""
            notes = [f"Not by detector and SAM: {why} {ladder['detector'].remedy}"] if why else []
            _tell(options, *notes, *plan.notes, plan.sentence)
            made = None if options.dry_run else _made(session, plan, progress)
            session.flush()
        finally:
            session.close()
    if options.json:
        print(json.dumps(_as_json(plan, made, ladder), indent=2))
    elif made is not None:
        _print_made(plan, made, options)
    return 0


def _made(session: Session, plan: MaskPlan, progress: Any) -> MadeMasks:
    from dbh_studio.app.jobs import run_job
    from dbh_studio.app.mask_making import make_masks as work
    from dbh_studio.app.plot_masks import mask_store

    try:
        made: MadeMasks = run_job(work, plan, progress=progress)
    except KeyboardInterrupt:
        progress.finish()
        names = {photo.name for photo in plan.photos}
        n_made = sum(entry.image in names and entry.key == plan.recipe.key for entry in mask_store(session).entries)
        print(plain(f"note: {counted(n_made, 'mask')} of {len(plan.photos)} are made and kept."), file=sys.stderr)
        raise
    return made


def _check_can_make(ladder: Ladder, request: MakeRequest) -> None:
    """Raise ModelError where no masks can be made as asked for."""
    if request.rung == "auto" and ladder["detector"].can_make:
        return
    # What the lower rung lacks, the higher one lacks, too.
    state = ladder["prompted" if request.rung == "auto" else request.rung]
    if not state.can_make:
        raise ModelError(f"No masks can be made by {state.title}: {state.why_not}", state.remedy)


def _tell(options: argparse.Namespace, *notes: str) -> None:
    if not options.quiet:
        for note in notes:
            print(plain(f"note: {note}"), file=sys.stderr)


def _print_made(plan: MaskPlan, made: MadeMasks, options: argparse.Namespace) -> None:
    from dbh_studio.app.mask_costs import duration

    for problem in made.problems.values():
        print(plain(f"left out: {problem}"), file=sys.stderr)
    each = "" if made.seconds_per_photo is None else f", {duration(made.seconds_per_photo)} each"
    print(plain(f"{counted(made.n_made, 'mask')} made{each}, {made.n_trunks:,} trunks outlined: {plan.folder}"))
    if options.plot.suffix == ".dbh":
        run = f"dbh-studio run {shlex.quote(str(options.plot))} --out … --masks stored --overwrite"
        print(plain(f"Find the trunks by them: {run}"))
    else:
        print("They are kept in the cache until the plot is saved: dbh-studio run … --masks stored")


def _as_json(plan: MaskPlan, made: MadeMasks | None, ladder: Ladder) -> dict[str, Any]:
    return {
        "rung": plan.rung,
        "models": plan.models,
        "folder": str(plan.folder),
        "photos": [photo.name for photo in plan.photos],
        "n_photos": plan.n_photos,
        "n_kept": plan.n_kept,
        "share_covered": plan.share_covered,
        "estimated_seconds": round(plan.cost.seconds),
        "is_measured": plan.cost.is_measured,
        "n_made": 0 if made is None else made.n_made,
        "seconds_per_photo": None if made is None else made.seconds_per_photo,
        "problems": {} if made is None else dict(made.problems),
        "notes": list(plan.notes if made is None else made.notes),
        "ladder": ladder.as_json(),
    }


# ---- what is there


def list_masks(options: argparse.Namespace) -> int:
    """Print every photo and its mask."""
    from dbh_studio.app.plot_masks import states_of

    with _kept(options, write=False) as (store, posed):
        rows = states_of(store, posed)
        if options.json:
            print(json.dumps({"folder": str(store.folder), "photos": [_row(each) for each in rows]}, indent=2))
            return 0
        print(plain(f"Masks in {store.folder}\n"))
        print(f"{'photo':<32} {'mask by':<10} {'trunks':>6} {'score':>5}  remark")
        for each in rows:
            if each.origin:
                score = "" if each.score is None else f"{each.score:.2f}"
                print(plain(f"{each.photo:<32} {each.origin:<10} {each.n_trunks:>6} {score:>5}  {_remark(each)}"))
        counts = Counter(each.origin or "none" for each in rows)
        n_voting = sum(each.votes for each in rows)
        n_without = counts.pop("none", 0)
        print(f"\n{counted(len(rows), 'photo')}: {n_voting} with a mask that votes, {n_without} without a mask")
    return 0


def _remark(state: MaskState) -> str:
    parts: list[str] = [state.review] if state.review else []
    if state.is_outdated:
        parts.append("the photo has changed since, so it does not vote")
    return ", ".join(parts)


def _row(state: MaskState) -> dict[str, Any]:
    names = ("photo", "has_photo", "has_mask", "votes", "review", "origin", "n_trunks", "score", "is_outdated")
    return {name: getattr(state, name) for name in names}


def show_mask(options: argparse.Namespace) -> int:
    """Write a photo with its mask."""
    from dbh_studio.app.mask_overlay import check_overlay_path, save_overlay
    from dbh_studio.io.masks import overlay
    from dbh_studio.io.masks.store import read_stored
    from dbh_studio.io.photos import read_photo

    check_overlay_path(options.picture)
    with _kept(options, write=False) as (store, posed):
        entry = store.entry(options.photo)
        photo = next((each for each in posed if each.name == options.photo), None)
        if entry is None or photo is None:
            raise CommandError(f"There is no kept mask of {options.photo}.", "`dbh-studio masks list` shows all.")
        mask = read_stored(store.folder, entry)
        save_overlay(options.picture, overlay(read_photo(photo), mask))
        if options.json:
            print(json.dumps({"photo": photo.name, "picture": str(options.picture), "trunks": list(mask.numbers)}))
        else:
            print(plain(f"{photo.name}: {counted(len(mask.numbers), 'trunk')}, drawn in {options.picture}"))
    return 0


def review_masks(options: argparse.Namespace) -> int:
    """Note what the person says."""
    from dbh_studio.app.plot_masks import review_in, states_of

    with _kept(options, write=True) as (store, posed):
        for name in options.photos:
            # All are there, or nothing is changed.
            if store.entry(name) is None:
                raise CommandError(
                    f"There is no kept mask of {name}.", "`dbh-studio masks list` shows which there are."
                )
        for name in options.photos:
            review_in(store, name, _REVIEWS[options.verdict])  # type: ignore[arg-type]
        rows = [each for each in states_of(store, posed) if each.photo in options.photos]
    if options.json:
        print(json.dumps([_row(each) for each in rows], indent=2))
    else:
        n_voting = sum(each.votes for each in rows)
        print(f"{counted(len(options.photos), 'mask')} {_REVIEWS[options.verdict] or 'without a review'}; "
              f"{n_voting} of them vote when the trunks are found next.")  # fmt: skip
    return 0


@contextmanager
def _kept(options: argparse.Namespace, *, write: bool) -> Iterator[tuple[MaskStore, PosedImages]]:
    """The masks of a plot and its photos. Of a saved plot the cloud is not read; to write, it is locked."""
    from dbh_studio.app.plot_masks import MASKS_FOLDER, mask_store
    from dbh_studio.io.masks import MaskStore
    from dbh_studio.io.posed import read_posed_images
    from dbh_studio.io.project import ProjectWriter, is_project, read_project

    if not is_project(options.plot):
        from dbh_studio.app.opening import open_plot
        from dbh_studio.app.photo_scale import PhotoRequest, add_photos

        session = open_plot(options.plot, background_save=False)
        try:
            cameras = add_photos(session, PhotoRequest(options.cameras, options.images))
            yield mask_store(session), cameras.posed
        finally:
            session.close()
        return
    state = read_project(options.plot)
    writer = ProjectWriter(options.plot) if write else None
    try:
        place = state.cameras
        path = options.cameras or (None if place is None else place.path)
        if path is None:
            raise CommandError("The saved plot has no photos.", "Say where their poses are: --cameras PATH.")
        images = options.images or (None if place is None else place.images_dir)
        if not os.path.exists(path):  # noqa: PTH110 - pathlib raises where a folder may not be entered
            raise FileError(path, "The photos' poses are not there any more.", "Say where they are: --cameras PATH.")
        yield MaskStore(Path(options.plot) / MASKS_FOLDER), read_posed_images(path, images_dir=images)
    finally:
        if writer is not None:
            writer.close()
