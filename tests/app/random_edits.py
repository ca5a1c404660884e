"""Random edits of a small plot, the same for the same seed, and everything a plot says, comparable."""

from __future__ import annotations

import numpy as np

from dbh_studio.app import commands, edits
from dbh_studio.app.commands import Command
from dbh_studio.app.document import Document
from dbh_studio.app.session import History, Session
from dbh_studio.core.corrections import Correction
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.tree_record import Review
from dbh_studio.errors import CommandError

N_POINTS = 300


def contents(document: Document) -> tuple:
    """All of a Document, comparable."""
    trunks = tuple((t.id, t.origin, t.points.tobytes()) for t in document.trunks)
    fields = (document.plot_id, document.up_direction, document.north_direction, document.origin_src, document.scale)
    others = (document.settings, document.evidence, document.cameras, document.masks)
    return (*fields, *others, trunks, document.trunks.next_id, dict(document.trees))


def all_of(history: History) -> tuple:
    """All of a plot with what Undo and Redo lead to, comparable."""
    past = tuple((label, contents(document)) for label, document in history.past)
    future = tuple((label, contents(document)) for label, document in history.future)
    return contents(history.present), past, future, history.next_id


def of(session: Session) -> tuple:
    """As `all_of`, of an open plot."""
    with session.held() as history:
        return all_of(history)


def random_command(rng: np.random.Generator, document: Document) -> Command:
    """One of all there are; it may not be applicable."""
    ids = list(document.trunks.ids) or [1]
    some = int(rng.choice(ids))
    points = np.unique(rng.integers(0, N_POINTS, int(rng.integers(3, 20))))
    of_trunk = document.trunks[some].points if some in document.trunks else points
    cut = int(rng.integers(0, len(of_trunk) + 1))
    where = tuple(rng.normal(size=3).tolist())
    makers = {
        "merge": lambda: edits.merge_trunks(rng.choice(ids, min(2, len(ids)), replace=False).tolist()),
        "split": lambda: edits.split_trunk(some, [of_trunk[:cut], of_trunk[cut:]]),
        "add": lambda: edits.add_trunk(points, may_take=bool(rng.integers(2))),
        "assign": lambda: edits.assign_points(points, some),
        "drop": lambda: edits.drop_points(points),
        "delete": lambda: commands.delete_trunk(some),
        "group": lambda: edits.group_stems(ids[:2]),
        "describe": lambda: commands.set_tree_record(some, species=str(rng.choice(["oak", "«Köln»", ""])), note="x"),
        "field": lambda: commands.set_tree_fields([some], vigour=str(rng.integers(3))),
        "tape": lambda: commands.correct_measurement(some, Correction("tape", float(rng.uniform(10, 60)), "Ada")),
        "ground": lambda: commands.correct_measurement(some, Correction("ground", where, "Ada", "2026", "a stump")),
        "left out": lambda: commands.correct_measurement(some, Correction("left_out", tuple(points.tolist()))),
        "withdraw": lambda: commands.withdraw_correction(some, "tape"),
        "review": lambda: commands.review_trees({some: Review("accepted", 31.4, "", "Ada", "2026")}),
        "scale": lambda: commands.set_scale(ScaleEstimate(float(rng.uniform(0.1, 9)), "bars", 0.1)),
        "up": lambda: commands.set_up(where),
        "frame": lambda: commands.set_frame(north=where, origin_src=where),
        "settings": lambda: commands.change_settings("measure", breast_height_m=float(rng.uniform(1, 2))),
        "name": lambda: commands.rename_plot(f"plot {rng.integers(9)}"),
    }
    return makers[str(rng.choice(list(makers)))]()


def random_step(rng: np.random.Generator, session: Session) -> None:
    """A random command, or Undo, or Redo, or one of a trunk deleted earlier; one that is refused changes nothing."""
    kind = rng.random()
    try:
        if kind < 0.2:
            session.undo()
        elif kind < 0.3:
            session.redo()
        elif kind < 0.36 and session.earlier:
            _, earlier = session.earlier[int(rng.integers(len(session.earlier)))]
            gone = [i for i in earlier.trunks.ids if i not in session.document.trunks]
            if gone:
                session.do(commands.restore_trunk(earlier, gone[0]))
        else:
            session.do(random_command(rng, session.document))
    except CommandError:
        return
