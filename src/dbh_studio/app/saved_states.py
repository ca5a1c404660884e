"""Between the Documents of a Session and what is saved of them: the same things in the program's own types."""

from __future__ import annotations

from collections.abc import Sequence

from dbh_studio.app.document import CameraSource, Document, SourceInfo
from dbh_studio.app.session import History
from dbh_studio.io.project import CameraPlace, PlotState, UndoStates


def state_from_document(document: Document) -> PlotState:
    """What is saved of a Document: all of it."""
    source, cameras = document.source, document.cameras
    return PlotState(
        plot_id=document.plot_id,
        source_path=source.path,
        source_used=source.used,
        n_points=source.n_points,
        fingerprint=source.fingerprint,
        up_direction=document.up_direction,
        scale=document.scale,
        settings=document.settings,
        trunks=document.trunks,
        trees=document.trees,
        north_direction=document.north_direction,
        origin_src=document.origin_src,
        evidence=document.evidence,
        cameras=None if cameras is None else CameraPlace(cameras.path, cameras.images_dir, cameras.frame),
        masks=document.masks,
    )


def document_from_state(state: PlotState, source: SourceInfo) -> Document:
    """The Document that was saved, about `source`, which the caller has found to be the same cloud."""
    cameras = state.cameras
    return Document(
        plot_id=state.plot_id,
        source=source,
        up_direction=state.up_direction,
        scale=state.scale,
        settings=state.settings,
        trunks=state.trunks,
        trees=state.trees,
        north_direction=state.north_direction,
        origin_src=state.origin_src,
        evidence=state.evidence,
        cameras=None if cameras is None else CameraSource(cameras.path, cameras.images_dir, cameras.frame),
        masks=state.masks,
    )


def states_from_history(history: History, number: int) -> UndoStates:
    """What is saved of a plot with what Undo and Redo lead to, after `number` steps."""
    return UndoStates(
        state_from_document(history.present),
        tuple((label, state_from_document(document)) for label, document in history.past),
        tuple((label, state_from_document(document)) for label, document in history.future),
        number,
        history.next_id,
    )


def history_from_states(states: UndoStates, source: SourceInfo) -> History:
    """The Documents that were saved, about `source`.

    Raises:
        ValueError: One of them contradicts itself.
    """

    def documents(labelled: Sequence[tuple[str, PlotState]]) -> tuple[tuple[str, Document], ...]:
        return tuple((label, document_from_state(state, source)) for label, state in labelled)

    present = document_from_state(states.present, source)
    return History(present, documents(states.past), documents(states.future), states.next_id)
