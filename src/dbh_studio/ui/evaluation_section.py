"""The plot against diameters measured in the field: a part of the Export step."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import viser

from dbh_studio.app import pipeline
from dbh_studio.core.evaluation import ALL, MIN_N, Line, Sample
from dbh_studio.core.evaluation_figures import scatter_svg
from dbh_studio.errors import FileError, StudioError
from dbh_studio.io.evaluation_report import shown
from dbh_studio.ui import html
from dbh_studio.ui.bridge import call, esc
from dbh_studio.ui.panels.base import set_content, set_value, set_visible, typed_path
from dbh_studio.ui.signed import utc_now

if TYPE_CHECKING:
    from dbh_studio.app.document import Document
    from dbh_studio.app.evaluation import EvaluationRequest
    from dbh_studio.app.session import Session
    from dbh_studio.core.comparison import Comparison
    from dbh_studio.core.stem_layout import PairBy
    from dbh_studio.stages.measure import StemMeasurement
    from dbh_studio.ui.tab import Tab

_PAIR_BY: dict[str, PairBy] = {"as found": "auto", "number": "id", "place": "position"}
# In the words of `Grouping.parse`.
_APART = {
    "nothing": "",
    "quality": "inventory:quality",
    "ring seen": "inventory:coverage_deg:180,270",
    "diameter": "reference_cm",
}
_LINE_STATISTICS = (
    *("median_bias_cm", "mad_cm", "rcv_pct", "r_squared"),
    *("median_rel_err_pct", "p90_rel_err_pct", "rmse_cm"),
)
_MOST_KINDS = 12
_WORST_SHOWN = 15
_OTHERS_SHOWN = 10


class EvaluationSection:
    """Built at the GUI's current place, in a panel that brings it in step with the plot."""

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        self._done: tuple[Session, Document, EvaluationRequest, Comparison] | None = None
        # What was measured last by every method, and of which state of the plot.
        self._by_methods: tuple[Document, Sequence[StemMeasurement]] | None = None
        self._shown_for: Session | None = None
        self._failed: StudioError | None = None
        self._offered = dict(_APART)
        gui, worker = tab.client.gui, tab.worker
        self._folder = gui.add_folder("Compare with field measurements", expand_by_default=False, visible=False)
        with self._folder:
            self._path = gui.add_text(
                "Field table",
                "",
                hint="on the computer the studio runs on: a CSV with diameters measured by tape or calliper",
            )
            self._by = gui.add_dropdown(
                "Pair by", tuple(_PAIR_BY), hint="as found: by number where the places agree with it, else by place"
            )
            self._apart = gui.add_dropdown(
                "Tell apart by",
                tuple(_APART),
                hint="a line for each kind of tree; the columns of the field table can be chosen once it was read",
            )
            self._methods = gui.add_checkbox(
                "Every method", False, hint="also by the circle and the paper's three curves; takes longer"
            )
            compare = gui.add_button("Compare", icon=viser.Icon.SCALE, color="green")
            worker.on_click(compare, self._compare)
            for handle in (self._apart, self._methods):
                worker.on_update(handle, self._compare_again)
            self._state = gui.add_html("")
            self._lines = gui.add_html("", visible=False)
            self._plot = gui.add_html("", visible=False)
            self._worst = gui.add_html("", visible=False)
            self._tapes = gui.add_button(
                "Keep these as tape values of the trees",
                icon=viser.Icon.RULER_MEASURE,
                color="gray",
                visible=False,
                hint="beside the estimates, never mixed with them; Undo takes it back",
            )
            worker.on_click(self._tapes, self._keep_tapes)
            self._out = gui.add_text(
                "Report folder", "", visible=False, hint="table, pairs and figures are written there, on this computer"
            )
            self._write = gui.add_button("Write the report", icon=viser.Icon.FILE_EXPORT, color="gray", visible=False)
            worker.on_click(self._write, self._write_report)

    def refresh(self) -> None:
        """Say what was found, and whether the plot has changed since."""
        session = self.tab.session
        set_visible(self._folder, session is not None and len(session.document.trunks) > 0)
        if session is not self._shown_for:  # of another plot: its report must not be written over
            self._shown_for, self._done, self._by_methods, self._failed = session, None, None, None
            for field in (self._path, self._out):
                set_value(field, "")
            self._offer(_APART)
            set_value(self._methods, False)
        for handle in (self._lines, self._plot, self._worst, self._tapes, self._out, self._write):
            set_visible(handle, self._done is not None)
        if self._done is None or session is None:
            told = html.message("Type where a table with field diameters lies: its columns and units are found out.")
            if self._failed is not None:
                told = failure(self._failed)
            set_content(self._state, told)
            return
        _, document, _, comparison = self._done
        is_old = session.document is not document
        old = html.message("The plot has changed since. Press Compare again.") if is_old else ""
        set_content(self._state, old + summary(comparison))
        set_content(self._lines, lines_table(comparison))
        set_content(self._plot, scatter(comparison))
        set_content(self._worst, misfits(comparison))

    def _compare(self) -> None:
        """Compare the plot as it is; by every method once a job has measured it so, and until then by its own."""
        session = self.tab.require_session()
        document = session.document
        self._compare_state(session, document)
        if self._methods.value and self._methods_of(document) is None:
            self._start_measuring(session, document)

    def _methods_of(self, document: Document) -> Sequence[StemMeasurement] | None:
        known = self._by_methods
        return known[1] if known is not None and known[0] is document else None

    def _start_measuring(self, session: Session, document: Document) -> None:
        """Measure all stems by every method, in a job that Cancel stops."""
        worker = self.tab.worker

        def done(measured: Sequence[StemMeasurement]) -> None:
            worker.post(self._methods_measured, session, document, measured)

        try:
            self.tab.studio.start_job(
                "Measuring by every method",
                pipeline.measure_stems,
                pipeline.comparison_call(session, document),
                session,
                done,
                failed=lambda _: worker.post(self._methods_not_measured),
                if_stopped="the comparison is by the plot's own diameters.",
            )
        except StudioError:
            self._methods_not_measured()
            raise

    def _methods_measured(self, session: Session, document: Document, measured: Sequence[StemMeasurement]) -> None:
        if session is not self.tab.session:
            return
        self._by_methods = document, measured
        if self._methods.value and self._done is not None:
            self._compare_state(session, document)

    def _methods_not_measured(self) -> None:
        """What is ticked is what is on screen."""
        set_value(self._methods, False)

    def _compare_state(self, session: Session, document: Document) -> None:
        # Here, not above: scipy takes a second to import, and most sessions compare nothing.
        from dbh_studio.app.evaluation import EvaluationRequest, evaluate_plot
        from dbh_studio.core.comparison import Grouping
        from dbh_studio.core.stem_layout import PairingRule

        self._done = self._failed = None  # what is on screen must not pass for the answer while this one fails
        try:
            path = typed_path(self._path.value)
            if path is None:
                raise StudioError("No table was named.", "Type the path of a table of diameters measured in the field.")
            _check_measured(session, document)
            compared = self._methods_of(document)
            apart = self._offered.get(self._apart.value, "")
            request = EvaluationRequest(
                path,
                by=(Grouping.parse(apart),) if apart else (),
                rule=PairingRule(_PAIR_BY[self._by.value]),
                every_method=self._methods.value and compared is not None,
            )
            comparison = evaluate_plot(session, request, document=document, compared=compared)
            self._done = session, document, request, comparison
            self._offer(_APART | columns_to_tell_apart(comparison))
            if not self._out.value:
                set_value(self._out, str(_beside(session) / f"{document.plot_id or 'plot'}_evaluation"))
        except StudioError as error:
            self._failed = error
            raise
        finally:
            self.refresh()

    def _compare_again(self, _: object = None) -> None:
        """What is on screen follows what is chosen; before the first comparison there is nothing to follow."""
        if self._done is not None:
            self._compare()

    def _offer(self, words: dict[str, str]) -> None:
        """Let these be chosen from; what is chosen stays, where it is still there."""
        if tuple(words) != tuple(self._offered):
            chosen = self._apart.value if self._apart.value in words else next(iter(words))
            self._offered = words
            self._apart.options = tuple(words)
            set_value(self._apart, chosen)

    def _keep_tapes(self) -> None:
        """Keep the field value of every tree that has a pair, refused ones among them."""
        from dbh_studio.app.section_edits import keep_tapes

        if self._done is None:
            raise StudioError("Nothing was compared yet.", "Press Compare first.")
        session, _, request, comparison = self._done
        tapes = paired_tapes_cm(comparison)
        session.do(keep_tapes(tapes, who=session.author, when=utc_now(), why=request.reference.name))
        self.tab.worker.notify(
            f"{len(tapes)} tape values kept", "They stand beside the estimates, in step 4.", "success"
        )

    def _write_report(self) -> None:
        from dbh_studio.app.evaluation import section_pictures, write_report

        if self._done is None:
            raise StudioError("Nothing was compared yet.", "Press Compare first.")
        session, document, request, comparison = self._done
        text = self._out.value.strip().strip("\"'")
        if not text:
            raise StudioError("No folder was named.", "Type where the report shall go.")
        folder = _beside(session) / os.path.expanduser(text)  # noqa: PTH111 - pathlib's raises
        # Cross-sections are those of the plot as it is: they may only stand beside the numbers of the same state.
        pictures = section_pictures(session, comparison) if session.document is document else ()
        written = write_report(comparison, folder, pictures=pictures, sources=[request.reference])
        self.tab.worker.notify("Report written", f"{len(written)} files in {folder}; begin with report.md.", "success")


def failure(error: StudioError) -> str:
    """HTML: why nothing could be compared; it stands where the answer would, and never asks for what was given."""
    where = f"{error.path.name or error.path}: " if isinstance(error, FileError) else ""
    return html.message(f"{where}{error.problem}", level="stop", remedy=error.remedy)


def _check_measured(session: Session, document: Document) -> None:
    session.require_scale()
    n_waiting = len(session.unmeasured(document))
    if n_waiting:
        raise StudioError(f"{n_waiting} trees are not measured yet.", "Wait for it, or press Measure above.")


def _beside(session: Session) -> Path:
    """The folder the plot lies in."""
    folder = getattr(session.saver, "folder", None)
    return Path(folder if folder is not None else session.document.source.path).absolute().parent


def paired_tapes_cm(comparison: Comparison) -> dict[int, float]:
    """The field diameter of each tree of the plot that was found in the field table, cm."""
    numbers = _numbers(comparison)
    return {
        numbers[sample.stem]: float(sample.reference_cm)
        for sample in comparison.samples
        if sample.reference_cm is not None and sample.stem in numbers
    }


def _whole(comparison: Comparison) -> Line:
    return next(line for line in comparison.lines if line.category == ALL)


def summary(comparison: Comparison) -> str:
    """HTML: bias, scatter and counts."""
    line = _whole(comparison)
    s = line.statistics
    pairs = [("Trees with both diameters", str(s.n))]
    if s.median_bias_cm is not None and s.mean_bias_cm is not None and s.rmse_cm is not None:
        pairs += [
            ("Median bias", f"{shown(s, 'median_bias_cm', with_sign=True)} cm"),
            ("Mean bias", f"{shown(s, 'mean_bias_cm', with_sign=True)} cm"),
            ("RMSE", f"{shown(s, 'rmse_cm')} cm"),
            ("MAD, rCV", f"{shown(s, 'mad_cm')} cm, {shown(s, 'rcv_pct')} %"),
            ("Median relative error", f"{shown(s, 'median_rel_err_pct')} %"),
        ]
    if s.p90_rel_err_pct is not None:
        pairs.append(("9 of 10 are within", f"{shown(s, 'p90_rel_err_pct')} %"))
    if s.r_squared is not None:
        pairs.append(("R²", shown(s, "r_squared")))
    if s.n_intervals:
        pairs.append(("Interval holds the field value", f"{s.n_covered} of {s.n_intervals}"))
    n_found = line.n_measured + line.n_refused
    pairs.append(("Field trees found", f"{n_found} of {line.n_reference}"))
    pairs.append(("Found without a diameter", str(line.n_refused)))
    pairs.append(("Only in this plot", str(line.n_extra)))
    few = "" if s.n >= MIN_N else html.message(f"{s.n} trees are too few for bias and scatter: {MIN_N} are needed.")
    return f'{few}<div class="dbh">{html.facts(pairs)}</div>'


def columns_to_tell_apart(comparison: Comparison) -> dict[str, str]:
    """Columns of both tables with a few different values: what is offered, and the same for `Grouping.parse`."""
    offered = {}
    for table, where, words in (
        (comparison.reference, "reference", "field table"),
        (comparison.inventories[0], "inventory", "this plot"),
    ):
        for column, cells in table.cells.items():
            kinds = {cell.strip() for cell in cells} - {""}
            # A column that says something else of every tree tells none apart; a colon would be taken for bounds.
            if 2 <= len(kinds) <= min(_MOST_KINDS, len(cells) // 2) and ":" not in column and column != "quality":
                offered[f"{column} ({words})"] = f"{where}:{column}"
    return offered


def lines_table(comparison: Comparison) -> str:
    """HTML: a line for each method and each kind of tree; empty where there is one line, which the summary says."""
    if len(comparison.lines) < 2:
        return ""
    with_method = len(comparison.methods) > 1
    heads = ("Trees", *(("Method",) if with_method else ()), "n", "Bias", "MAD", "rCV %", "R²", "Rel. %", "90th %")
    heads = (*heads, "RMSE", "No DBH", "Holds")
    rows = []
    for line in comparison.lines:
        s = line.statistics
        cells = [
            str(s.n),
            *(shown(s, name) for name in _LINE_STATISTICS),
            str(line.n_refused),
            f"{s.n_covered}/{s.n_intervals}" if s.n_intervals else "–",
        ]
        names = [line.category, *((line.method,) if with_method else ())]
        texts = "".join(f'<td class="text">{esc(name)}</td>' for name in names)
        numbers = "".join(f"<td>{esc(cell)}</td>" for cell in cells)
        rows.append(f'<tr data-line="{esc(line.category)}">{texts}{numbers}</tr>')
    n_texts = 2 if with_method else 1
    head = "".join(f"<th{' class=text' if k < n_texts else ''}>{name}</th>" for k, name in enumerate(heads))
    what = "Bias, MAD and RMSE in centimetres; a dash where too few trees have both diameters."
    return (
        '<div class="dbh"><div class="dbh-lines" tabindex="0"><table class="dbh-table" data-columns="even">'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
        f'<div class="muted">{what}</div></div>'
    )


def scatter(comparison: Comparison) -> str:
    """HTML: estimated against reference; a point names its tree, and a click on it chooses the tree."""
    numbers = _numbers(comparison)

    def marks(sample: Sample) -> str:
        number = numbers.get(sample.stem)
        if number is None:
            return ""
        return f'data-tree="{number}" style="cursor:pointer" onclick="{call("row", number)}"'

    picture = scatter_svg({"": comparison.samples}, comparison.methods, marks=marks, is_fluid=True)
    return f'<div class="dbh dbh-evaluation">{picture}</div>'


def misfits(comparison: Comparison) -> str:
    """HTML: the pairs that do not fit, worst first, then what has no pair and why, and how the tables were read."""
    numbers = _numbers(comparison)
    samples = [s for s in comparison.samples if s.method == comparison.methods[0]]
    measured = sorted((s for s in samples if s.error_pct is not None), key=lambda s: -abs(s.error_pct or 0.0))
    rows = "".join(_row(sample, numbers.get(sample.stem)) for sample in measured[:_WORST_SHOWN])
    table = (
        '<div class="dbh-scroll" tabindex="0"><table class="dbh-table"><thead><tr><th>Tree</th><th>Field</th>'
        f"<th>DBH</th><th>Tape</th><th>Error %</th></tr></thead><tbody>{rows}</tbody></table></div>"
    )
    refused = [_refused(s, numbers.get(s.stem)) for s in samples if s.outcome == "refused"]
    unmeasured = f"<div class=dbh-scroll tabindex=0><ul class=dbh-list>{''.join(refused)}</ul></div>" if refused else ""
    items = []
    for outcome, words in (("missed", "was not found"), ("unknown", "has no field diameter")):
        some = [s for s in samples if s.outcome == outcome]
        items += [("note", f"Field tree {s.tree or '?'} {words}", s.reason) for s in some[:_OTHERS_SHOWN]]
        if len(some) > _OTHERS_SHOWN:
            items.append(("note", f"{len(some) - _OTHERS_SHOWN} more: the report lists them", ""))
    title = '<div class="muted">Worst pairs first, centimetres; click one to see the tree.</div>'
    notes = html.findings([("note", note, "") for note in comparison.notes])
    rest = html.findings(items) if items else ""
    how = f'<details class="dbh"><summary>How the tables were read and paired</summary>{notes}</details>'
    return f'<div class="dbh">{title}{table if rows else ""}{unmeasured}</div>{rest}{how}'


def _refused(sample: Sample, number: int | None) -> str:
    """A tree without a diameter by its number here, where it can be mended: a click shows it."""
    tree = f"Tree {esc(sample.stem)}"
    if number is not None:
        tree = f'<button type="button" data-refused="{number}" onclick="{call("row", number)}">Tree {number}</button>'
    words = f"(field tree {sample.tree or '?'}) has no diameter here."
    return f'<li data-level="note">{tree} {esc(words)} <span class="muted">{esc(sample.reason)}</span></li>'


def _row(sample: Sample, number: int | None) -> str:
    click = f' onclick="{call("row", number)}"' if number is not None else ""
    texts = (
        str(number) if number is not None else sample.stem,
        sample.tree,
        shown(sample, "estimated_cm"),
        shown(sample, "reference_cm"),
        shown(sample, "error_pct", with_sign=True),
    )
    cells = "".join(f"<td>{esc(text)}</td>" for text in texts)
    tip = f"off by {shown(sample, 'error_cm', with_sign=True)} cm"
    return f'<tr data-pair="{esc(texts[0])}" title="{esc(tip)}"{click}>{cells}</tr>'


def _numbers(comparison: Comparison) -> dict[str, int]:
    from dbh_studio.app.evaluation import stem_numbers

    return stem_numbers(comparison)
