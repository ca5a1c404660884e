"""Every edit of a plot, as a function `Document -> Document` with a label for the Undo button.

A command that cannot be applied raises `CommandError` and changes nothing.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.app.document import CameraSource, Direction, Document, unit_direction
from dbh_studio.core.arrays import Int32
from dbh_studio.core.corrections import Correction, CorrectionKind, with_correction, without_correction
from dbh_studio.core.mask_record import MaskRecord
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.scale_evidence import MarkerSquare, ScaleBar, ScaleEvidence
from dbh_studio.core.tree_record import Review, TreeRecord, check_text
from dbh_studio.core.trunks import MAX_TRUNK_ID, Trunk, TrunkSet
from dbh_studio.errors import CommandError, SettingError

# A detection that shares more than this part of its points with an old trunk is that trunk, found again. Above one half
# at most one old trunk can qualify.
_SAME_TRUNK_IOU = 0.5
# Of a known length, metres.
_SHORTEST_M, _LONGEST_M = 0.001, 10_000.0
_CORRECTED: dict[CorrectionKind, str] = {
    "breast_height": "breast height",
    "base": "base",
    "along": "way of measuring height",
    "above": "place of measurement",
    "ground": "ground",
    "curve": "curve",
    "least_arc": "arc that is enough",
    "left_out": "points",
    "ring": "ring",
    "tape": "tape value",
    "tape_height": "tape height",
}


@dataclass(frozen=True)
class Command:
    """An edit.

    Attributes:
        label: What it does, for the Undo button and the history: ``Delete trunk 5``.
        apply: Pure; returns the same object where there is nothing to change, raises `CommandError` where it cannot.
    """

    label: str
    apply: Callable[[Document], Document]


def rename_plot(plot_id: str) -> Command:
    """Call the plot something else."""
    name = plot_id.strip()

    def apply(document: Document) -> Document:
        if not name:
            raise CommandError("A plot needs a name.", "Type at least one letter or digit.")
        try:
            check_text("the name", name)
        except ValueError as error:
            raise CommandError(f"The plot cannot be called this: {error}.") from None
        return document if name == document.plot_id else replace(document, plot_id=name)

    return Command(f"Rename the plot to {name}", apply)


def set_scale(scale: ScaleEstimate) -> Command:
    """Say how long a source unit is. Trunks stay: they are indices."""

    def apply(document: Document) -> Document:
        return document if scale == document.scale else replace(document, scale=scale)

    label = "Forget the scale" if not scale.is_known else f"Set the scale to {scale.metres_per_unit:.6g} m per unit"
    return Command(label, apply)


def set_up(direction: str | Direction | NDArray[Any]) -> Command:
    """Say where the sky is: a named axis of the source or any direction in it."""

    def apply(document: Document) -> Document:
        try:
            up = unit_direction(direction)
        except ValueError as error:
            raise CommandError(f"The up direction was not understood: {error}.") from None
        return document if up == document.up_direction else replace(document, up_direction=up)

    return Command("Change the up direction", apply)


def set_evidence(evidence: ScaleEvidence, *, label: str, scale: ScaleEstimate | None = None) -> Command:
    """Keep other known lengths, and with `scale` take the scale from them in the same step."""

    def apply(document: Document) -> Document:
        after = document if evidence == document.evidence else replace(document, evidence=evidence)
        return after if scale is None or scale == after.scale else replace(after, scale=scale)

    return Command(label, apply)


def add_length(length: ScaleBar | MarkerSquare) -> Command:
    """Mark a known length, or put it in place of the one of the same name."""

    def apply(document: Document) -> Document:
        _check_length(length)
        return replace(document, evidence=document.evidence.with_length(length))

    return Command(f"Mark {length.name}", apply)


def change_length(name: str, /, **values: Any) -> Command:
    """Say another `length_m`, `side_m`, `role`, `name` or other field of a known length."""

    def apply(document: Document) -> Document:
        before = _known_length(document, name)
        try:
            after = replace(before, **values)
        except (TypeError, ValueError) as error:
            raise CommandError(f"This cannot be said about {name}: {error}.") from None
        if after == before:
            return document
        _check_length(after)
        if after.name != name and after.name in document.evidence:
            raise CommandError(f"There is a {after.name} already.", "Choose another name.")
        return replace(document, evidence=document.evidence.with_changed(name, after))

    return Command(f"Change {name}", apply)


def remove_length(name: str) -> Command:
    """Forget a known length. A scale taken from it stays until another is set."""

    def apply(document: Document) -> Document:
        _known_length(document, name)
        return replace(document, evidence=document.evidence.without(name))

    return Command(f"Remove {name}", apply)


def set_cameras(cameras: CameraSource | None) -> Command:
    """Say where the photos and their poses are."""

    def apply(document: Document) -> Document:
        return document if cameras == document.cameras else replace(document, cameras=cameras)

    return Command("Forget the photos" if cameras is None else f"Add the photos of {cameras.path.name}", apply)


def set_frame(
    *,
    up: str | Direction | NDArray[Any] | None = None,
    north: Direction | NDArray[Any] | None = None,
    origin_src: Direction | NDArray[Any] | None = None,
) -> Command:
    """Say where the sky, north and the plot's origin are, in one step; what is None stays as it is.

    Args:
        up: A named axis or any direction in the source.
        north: A direction in the source; its level part becomes +y.
        origin_src: Source units from the cloud's origin.
    """

    def apply(document: Document) -> Document:
        values: dict[str, Any] = {}
        try:
            if up is not None:
                values["up_direction"] = unit_direction(up)
            if north is not None:
                values["north_direction"] = unit_direction(north)
        except ValueError as error:
            raise CommandError(f"The direction was not understood: {error}.") from None
        if origin_src is not None:
            origin = np.asarray(origin_src, np.float64)
            if origin.shape != (3,) or not np.isfinite(origin).all():
                raise CommandError("The origin of the plot is nowhere.")
            values["origin_src"] = tuple(origin.tolist())
        after = replace(document, **values)
        same = all(getattr(document, name) == value for name, value in values.items())
        return document if same else after

    return Command("Set the plot's origin and directions", apply)


def change_settings(section: str, **values: Any) -> Command:
    """Change fields of one section of the settings: ``ground``, ``trunks`` or ``measure``."""

    def apply(document: Document) -> Document:
        if section not in type(document.settings).model_fields:
            raise CommandError(f"There are no settings called {section!r}.")
        before = getattr(document.settings, section)
        try:
            after = before.changed(**values)
        except SettingError as error:
            raise CommandError(error.problem, error.remedy) from error
        if after == before:
            return document
        return replace(document, settings=document.settings.model_copy(update={section: after}))

    return Command(f"Change the {section} settings", apply)


def replace_trunks(
    trunks: TrunkSet, *, label: str = "", masks: MaskRecord | None = None, flags: Mapping[int, str] | None = None
) -> Command:
    """Put newly found trunks in place of all there are, and note by which masks they were found; None: by none.

    A new trunk that is an old one found again keeps its id and what was said about it. One from the file keeps the
    file's number, unless that is the number of another trunk that is present. The others get new ids; but in a plot
    that never had a trunk the given ids are kept. Flags of an earlier search go; `flags` (by the given ids) come.
    """

    def apply(document: Document) -> Document:
        _check_indices(trunks, document.source.n_points)
        numbered = trunks if document.trunks.next_id == 1 else _renumbered(trunks, document)
        # By the first point: ids may be others now, and points belong to one trunk.
        flag_at = {int(trunks[i].points[0]): text for i, text in (flags or {}).items()}
        flag_of = {trunk.id: flag_at.get(int(trunk.points[0]), "") for trunk in numbered}
        # A record speaks of the stem; that its points were set by hand is no longer so.
        trees = {
            i: replace(document.record(i), edited=False, flag=flag)
            for i, flag in flag_of.items()
            if flag or i in document.trees
        }
        return replace(document, trunks=numbered, trees=trees, masks=masks)

    return Command(label or f"Find {len(trunks)} trunks", apply)


def delete_trunk(trunk_id: int) -> Command:
    """Take one trunk away. Its id is not given out again."""

    def apply(document: Document) -> Document:
        existing_trunk(document, trunk_id)
        trees = {i: record for i, record in document.trees.items() if i != trunk_id}
        return replace(document, trunks=document.trunks.without(trunk_id), trees=trees)

    return Command(f"Delete trunk {trunk_id}", apply)


def restore_trunk(earlier: Document, trunk_id: int) -> Command:
    """Bring one trunk back as it was in an earlier Document, with what was said about it."""

    def apply(document: Document) -> Document:
        trunk = existing_trunk(earlier, trunk_id)
        if earlier.source.fingerprint != document.source.fingerprint:
            raise CommandError(f"Trunk {trunk_id} belongs to another cloud.")
        if trunk_id in document.trunks:
            raise CommandError(f"Trunk {trunk_id} is still there.", "Delete it first, or use Undo.")
        _check_free(document.trunks, trunk)
        trees = dict(document.trees)
        if trunk_id in earlier.trees:
            trees[trunk_id] = earlier.trees[trunk_id]
        return replace(document, trunks=document.trunks.with_trunk(trunk), trees=trees)

    return Command(f"Restore trunk {trunk_id}", apply)


def set_tree_record(trunk_id: int, **values: Any) -> Command:
    """Say something about a stem: `species`, `status`, `note`, `tag`, `tree_id` or another field of `TreeRecord`."""
    return describe_trees([trunk_id], **values)


def describe_trees(ids: Iterable[int], **values: Any) -> Command:
    """Say the same about several stems, in one step."""
    wanted = sorted(set(ids))

    def apply(document: Document) -> Document:
        return with_records(document, {i: _described(document, i, values) for i in wanted})

    names = f"trunk {wanted[0]}" if len(wanted) == 1 else f"{len(wanted)} trunks"
    return Command(f"Describe {names}", apply)


def set_tree_fields(ids: Iterable[int], /, **values: str) -> Command:
    """Fill fields of one's own, by name, of several stems; an empty text clears the field, others stay."""
    wanted = sorted(set(ids))

    def apply(document: Document) -> Document:
        records = {}
        for i in wanted:
            existing_trunk(document, i)
            records[i] = _described(document, i, {"fields": dict(document.record(i).fields) | values})
        return with_records(document, records)

    names = f"trunk {wanted[0]}" if len(wanted) == 1 else f"{len(wanted)} trunks"
    return Command(f"Describe {names}", apply)


def correct_measurement(trunk_id: int, correction: Correction) -> Command:
    """Measure one stem otherwise than the plot, in place of an earlier correction of the kind."""

    def apply(document: Document) -> Document:
        existing_trunk(document, trunk_id)
        record = document.record(trunk_id)
        if correction.kind == "left_out" and correction.value[-1] >= document.source.n_points:
            raise CommandError("Points were left out that are not in the cloud.", "Select them again.")
        if record.correction(correction.kind) == correction.value:
            return document
        corrections = with_correction(record.corrections, correction)
        return with_records(document, {trunk_id: replace(record, corrections=corrections)})

    return Command(f"Correct the {_CORRECTED[correction.kind]} of trunk {trunk_id}", apply)


def withdraw_correction(trunk_id: int, kind: CorrectionKind) -> Command:
    """Measure one stem as the plot again, in one respect."""

    def apply(document: Document) -> Document:
        existing_trunk(document, trunk_id)
        record = document.record(trunk_id)
        if record.correction(kind) is None:
            return document
        return with_records(
            document, {trunk_id: replace(record, corrections=without_correction(record.corrections, kind))}
        )

    return Command(f"Withdraw the {_CORRECTED[kind]} of trunk {trunk_id}", apply)


def review_trees(reviews: Mapping[int, Review | None]) -> Command:
    """Keep what was decided on looking at stems, by trunk id; None takes a decision back."""
    wanted = sorted(reviews)

    def apply(document: Document) -> Document:
        return with_records(document, {i: _described(document, i, {"review": reviews[i]}) for i in wanted})

    names = f"trunk {wanted[0]}" if len(wanted) == 1 else f"{len(wanted)} trunks"
    return Command(f"Review {names}", apply)


def with_records(document: Document, records: Mapping[int, TreeRecord]) -> Document:
    """The document with other records of stems; the same object where none differs, empty records are not kept."""
    if all(document.record(i) == record for i, record in records.items()):
        return document
    trees = {i: record for i, record in {**document.trees, **records}.items() if record != TreeRecord()}
    return replace(document, trees=trees)


def _described(document: Document, trunk_id: int, values: Mapping[str, Any]) -> TreeRecord:
    existing_trunk(document, trunk_id)
    try:
        return replace(document.record(trunk_id), **values)
    except (TypeError, ValueError) as error:
        raise CommandError(f"This cannot be said about trunk {trunk_id}: {error}.") from None


def _known_length(document: Document, name: str) -> ScaleBar | MarkerSquare:
    if name not in document.evidence:
        raise CommandError(f"There is no known length {name}.")
    return document.evidence[name]


def _check_length(length: ScaleBar | MarkerSquare) -> None:
    """Raise CommandError where its name or numbers make no sense."""
    try:
        check_text("the name", length.name)
    except ValueError as error:
        raise CommandError(f"The length cannot be called this: {error}.") from None
    if not length.name.strip():
        raise CommandError("A known length needs a name.", "Type at least one letter or digit.")
    true_m = length.length_m
    if not (np.isfinite(true_m) and _SHORTEST_M <= true_m <= _LONGEST_M):
        raise CommandError(
            f"{length.name} cannot be {true_m:g} m long.",
            f"Give its true length in metres, {_SHORTEST_M:g} to {_LONGEST_M:,.0f}.",
        )
    if not 0.0 <= length.length_se_m < true_m:
        raise CommandError(
            f"The error of {length.name} cannot be {length.length_se_m:g} m.",
            "Give 0 or more, and less than it is long.",
        )


def existing_trunk(document: Document, trunk_id: int) -> Trunk:
    """The trunk of that number.

    Raises:
        CommandError: There is none.
    """
    if trunk_id not in document.trunks:
        raise CommandError(f"There is no trunk {trunk_id}.", "It may have been merged or deleted: see Undo.")
    return document.trunks[trunk_id]


def _check_indices(trunks: Iterable[Trunk], n_points: int) -> None:
    """Raise CommandError unless the trunks are disjoint and inside the cloud."""
    is_taken = np.zeros(n_points, bool)
    for trunk in trunks:
        # Sorted, so that the ends tell the range.
        if not len(trunk) or trunk.points[0] < 0 or trunk.points[-1] >= n_points:
            raise CommandError(f"Trunk {trunk.id} has no points or points that are not in the cloud.")
        if is_taken[trunk.points].any():
            raise CommandError(f"Trunk {trunk.id} shares points with another trunk.")
        is_taken[trunk.points] = True


def _check_free(trunks: TrunkSet, wanted: Trunk) -> None:
    for other in trunks:
        if np.isin(wanted.points, other.points, assume_unique=True).any():
            raise CommandError(
                f"Points of trunk {wanted.id} now belong to trunk {other.id}.", f"Delete trunk {other.id} first."
            )


def _renumbered(trunks: TrunkSet, document: Document) -> TrunkSet:
    """The trunks with the ids they keep (see `replace_trunks`), and new ids for the others, in the order given."""
    old = document.trunks
    old_labels = old.labels(document.source.n_points)
    kept = [
        _found_again(trunk, old, old_labels) or (trunk.id if trunk.origin == "file" and trunk.id not in old else None)
        for trunk in trunks
    ]
    first_new = max([old.next_id, *(trunk_id + 1 for trunk_id in kept if trunk_id is not None)])
    next_id = first_new + kept.count(None)
    if next_id > MAX_TRUNK_ID + 1:
        raise CommandError("There are not enough numbers left for the new trunks.", "Begin a new plot from the cloud.")
    new_ids = itertools.count(first_new)
    ids = (next(new_ids) if trunk_id is None else trunk_id for trunk_id in kept)
    return TrunkSet(tuple(replace(trunk, id=i) for trunk, i in zip(trunks, ids, strict=True)), next_id)


def _found_again(trunk: Trunk, old: TrunkSet, old_labels: Int32) -> int | None:
    """The id of the old trunk that `trunk` is."""
    labels, counts = np.unique(old_labels[trunk.points], return_counts=True)
    counts[labels == 0] = 0
    candidate, n_shared = int(labels[counts.argmax()]), int(counts.max())
    n_union = len(trunk) + (len(old[candidate]) if candidate else 0) - n_shared
    return candidate if candidate and n_shared > _SAME_TRUNK_IOU * n_union else None
