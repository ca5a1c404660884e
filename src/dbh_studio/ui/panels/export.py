"""Step 5: hand it in."""

from __future__ import annotations

import viser

from dbh_studio.core.dbh import DbhEstimate
from dbh_studio.errors import StudioError
from dbh_studio.io.inventory_csv import inventory_csv
from dbh_studio.ui import html
from dbh_studio.ui.evaluation_section import EvaluationSection
from dbh_studio.ui.export_section import ExportSection
from dbh_studio.ui.import_section import ImportSection
from dbh_studio.ui.panels.base import Panel, set_content, set_visible
from dbh_studio.ui.transfer_section import TransferSection


class ExportPanel(Panel):
    """The inventory as CSV, and where the plot is saved."""

    step = "export"

    def build(self) -> None:
        """Add the inputs."""
        self._state = self.gui.add_html("")
        self._download = self.gui.add_button(
            "Download the inventory (CSV)", icon=viser.Icon.DOWNLOAD, color="green", visible=False
        )
        self.tab.worker.on_click(self._download, self._export)
        self._files = ExportSection(self.tab)
        self._bring_in = ImportSection(self.tab)
        self._evaluation = EvaluationSection(self.tab)
        self._transfer = TransferSection(self.tab)

    def set_busy(self, busy: bool) -> None:
        """One job at a time."""
        self._files.set_busy(busy)
        self._bring_in.set_busy(busy)
        self._transfer.set_busy(busy)

    def refresh(self) -> None:
        """Say what will be in the file."""
        self._files.refresh()
        self._bring_in.refresh()
        self._evaluation.refresh()
        self._transfer.refresh()
        session = self.tab.session
        has_trees = session is not None and len(session.document.trunks) > 0
        set_visible(self._download, has_trees)
        if session is None or not has_trees:
            set_content(self._state, html.message("There is nothing to export yet: find the trunks first."))
            return
        document = session.document
        waiting = set(session.unmeasured(document))
        measured = [i for i in document.trunks.ids if i not in waiting]
        results = [session.measurement(i, document=document).result for i in measured]
        diameters = [result.dbh_cm for result in results if isinstance(result, DbhEstimate)]
        n_without = len(results) - len(diameters)
        pairs = [
            ("Trees", str(len(document.trunks))),
            ("With a diameter", str(len(diameters))),
            ("Without", f"{n_without} (the file says why)" if n_without else "0"),
        ]
        if waiting:
            pairs.append(("Not measured yet", str(len(waiting))))
        if diameters:
            mean = sum(diameters) / len(diameters)
            pairs += [("Mean DBH", f"{mean:.1f} cm"), ("Range", f"{min(diameters):.1f}–{max(diameters):.1f} cm")]
        measure = document.settings.measure
        pairs += [
            ("Breast height", f"{measure.breast_height_m:.2f} m"),
            ("Curve", html.CURVE_TITLES.get(measure.curve, measure.curve)),
        ]
        set_content(self._state, f'<div class="dbh">{html.facts(pairs)}</div>')

    def _export(self) -> None:
        session = self.tab.require_session()
        document = session.document
        n_waiting = len(session.unmeasured(document))
        if n_waiting:
            raise StudioError(f"{n_waiting} trees are not measured yet.", "Wait for it, or press Measure above.")
        content = inventory_csv(session.inventory(document=document))
        name = f"{document.plot_id}_inventory.csv"
        self.tab.client.send_file_download(name, content, save_immediately=True)
        self.tab.studio.exported(document)
        self.tab.worker.notify("Inventory exported", f"{name}, {len(document.trunks)} trees.", "success")
