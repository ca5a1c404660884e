"""From what a person draws or clicks to edits: cuts, growth, and a stem followed from a click.

They give commands, computed for the plot as it is: send them with ``based_on``, so that a change meanwhile refuses
them. Points are chosen with `app.edit_pool`, among all of the cloud, not among those on screen.

    points = pool_of(session, session.document, [7]).lasso(view, polygon)
    session.do(drop_points(points, 7))
    session.do(split_by_line(session, 7, view, (0.4, 0.2), (0.45, 0.9)))
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dbh_studio.app.commands import Command, existing_trunk
from dbh_studio.app.document import Document
from dbh_studio.app.edit_pool import blocks_of
from dbh_studio.app.edits import LEAST_POINTS, add_trunk, assign_points, keep_only, split_trunk
from dbh_studio.app.session import Session
from dbh_studio.core.arrays import Int64
from dbh_studio.core.dbh import Refusal
from dbh_studio.core.picking import View
from dbh_studio.core.trunk_edits import beyond_plane, grown, n_beside_line, plane_of_line, shrunk
from dbh_studio.core.trunks import Trunk
from dbh_studio.errors import CommandError
from dbh_studio.settings import TrunkSettings

# What a trunk grows or shrinks by at a press of a key, metres.
STEP_M = 0.03


def split_by_line(session: Session, trunk_id: int, view: View, first_xy: Any, last_xy: Any) -> Command:
    """Cut a trunk in two along a line drawn on the screen; beyond its ends the cut goes on.

    Raises:
        CommandError: There is no such trunk, the line is no line, or it misses the trunk.
    """
    try:
        through, normal = plane_of_line(view, first_xy, last_xy)
    except ValueError:
        raise CommandError("The line is too short to cut along.", "Draw it through the whole trunk.") from None
    points = session.points_world(session.document)[existing_trunk(session.document, trunk_id).points]
    # A line beside the trunk may well point at it, and what lies beyond its ends is cut, too.
    if min(n_beside_line(view, points, first_xy, last_xy)) < LEAST_POINTS:
        raise CommandError(
            f"The line does not cross trunk {trunk_id}.", "Draw it through the trunk, so that parts lie on both sides."
        )
    return split_by_plane(session, trunk_id, through, normal)


def split_by_plane(session: Session, trunk_id: int, through_world: Any, normal_world: Any) -> Command:
    """Cut a trunk in two along a plane.

    Raises:
        CommandError: There is no such trunk.
    """
    document = session.document
    trunk = existing_trunk(document, trunk_id)
    beyond = beyond_plane(session.points_world(document)[trunk.points], through_world, normal_world)
    return split_trunk(trunk_id, [trunk.points[beyond], trunk.points[~beyond]])


def split_by_stems(session: Session, trunk_id: int) -> Command:
    """Part a trunk into the stems that are seen in it: twins, a fork below breast height, a neighbour.

    Raises:
        CommandError: Only one stem is seen; says what to do instead.
        UnscaledCloudError: The scale is not known.
    """
    from dbh_studio.stages.stem_edits import part_stems

    document = session.document
    trunk = existing_trunk(document, trunk_id)
    session.require_scale(document)
    labels = part_stems(
        session.points_world(document)[trunk.points],
        session.ground(document=document),
        settings=document.settings.trunks,
        seed=document.settings.measure.seed,
    )
    if isinstance(labels, Refusal):
        raise CommandError(labels.reason, labels.remedy)
    return split_trunk(trunk_id, [trunk.points[labels == part] for part in range(int(labels.max()) + 1)])


def add_by_click(session: Session, seed_world: Any) -> tuple[Command, str]:
    """Follow the stem that a click hit and make a trunk of it; points of other trunks are left where they are.

    Returns:
        The command, and what must be looked at; empty where the stem was sure.

    Raises:
        CommandError: There is no stem there; says what to do instead.
        UnscaledCloudError: The scale is not known.
    """
    from dbh_studio.stages.stem_edits import grow_stem

    document = session.document
    session.require_scale(document)
    points, settings = session.points_world(document), document.settings.trunks
    place, reach = np.asarray(seed_world, np.float64).reshape(3), _reach_of_stem_m(settings)
    about = np.array([reach, reach, np.inf])
    rows = blocks_of(session, document).in_box(place - about, place + about)
    stem = grow_stem(
        points.take(rows, axis=0),
        place,
        session.ground(document=document),
        is_free=~_owned(document)[rows],
        settings=settings,
        seed=document.settings.measure.seed,
    )
    if isinstance(stem, Refusal):
        raise CommandError(stem.reason, stem.remedy)
    return add_trunk(rows[stem.rows]), stem.note


def grow_trunk(session: Session, trunk_id: int, distance_m: float = STEP_M) -> Command:
    """Let the free points within a distance of a trunk join it."""
    document = session.document
    trunk = existing_trunk(document, trunk_id)
    points = session.points_world(document)
    near = _near(session, document, trunk, distance_m)
    free = near[~_owned(document)[near]]
    joins = grown(points, trunk.points, free, distance_m)
    if not len(joins):
        raise CommandError(
            f"There are no free points within {100 * distance_m:.0f} cm of trunk {trunk_id}.",
            "Choose them with the lasso, and give them to it.",
        )
    return assign_points(joins, trunk_id)


def shrink_trunk(session: Session, trunk_id: int, distance_m: float = STEP_M) -> Command:
    """Take off a trunk its rim: what is within a distance of points of others, or nearly alone.

    Raises:
        CommandError: Nothing of it would be left.
    """
    document = session.document
    trunk = existing_trunk(document, trunk_id)
    points = session.points_world(document)
    others = np.setdiff1d(_near(session, document, trunk, distance_m), trunk.points, assume_unique=True)
    left = shrunk(points, trunk.points, others, distance_m)
    if len(left) < 3:
        raise CommandError(f"Nothing of trunk {trunk_id} would be left.", "Shrink it by less, or delete it.")
    return keep_only(left, trunk_id)


def _owned(document: Document) -> np.ndarray:
    """(N,) which points belong to a trunk."""
    owned = np.zeros(document.source.n_points, bool)
    for trunk in document.trunks:
        owned[trunk.points] = True
    return owned


def _near(session: Session, document: Document, trunk: Trunk, distance: float) -> Int64:
    """Rows of the points in the trunk's box, wider by a distance on all sides."""
    own = session.points_world(document)[trunk.points]
    return blocks_of(session, document).in_box(own.min(axis=0) - distance, own.max(axis=0) + distance)


def _reach_of_stem_m(settings: TrunkSettings) -> float:
    """How far from a click the points of the stem may be, in plan; a little more than is looked at."""
    return 0.5e-2 * settings.max_diameter_cm + 1.5
