"""What `cleargs watch` shows while a run is at work: how far it is, and the youngest preview."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cleargs.pipeline.dag import Dag
from cleargs.pipeline.live import AtWork, at_work, preview_of
from cleargs.pipeline.run_file import Run
from cleargs.report.report_json import is_current, linked_manifests, page_of


class Watched:
    """One run, looked at anew in each call."""

    def __init__(self, dag: Dag, run: Run) -> None:
        self._dag, self._run = dag, run

    @property
    def folder(self) -> Path:
        """The run's."""
        return self._run.folder

    def is_done(self) -> bool:
        """Whether nobody is at work and the report is of the present results."""
        manifests = linked_manifests(self.folder, self._dag.names)
        return self._at_work() is None and is_current(self.folder, manifests)

    def state(self) -> dict[str, Any]:
        """All that the page shows, as JSON values."""
        found = self._at_work()
        manifests = linked_manifests(self.folder, self._dag.names)
        picture = None if found is None else preview_of(found, self._run.store)
        stages = []
        for name in self._dag.names:
            working = found is not None and found.stage == name
            state = "at work" if working else "done" if name in manifests else "to do"
            seconds = manifests[name].seconds if state == "done" else None
            stages.append({"name": name, "state": state, "seconds": seconds})
        return {
            "name": self.folder.name,
            "now": None if found is None else found.model_dump(),
            "stages": stages,
            "preview": None if picture is None else str(picture.version),
            "report": page_of(self.folder).is_file(),
            "done": found is None and is_current(self.folder, manifests),
        }

    def preview(self) -> Path | None:
        """The youngest preview; None where there is none."""
        found = self._at_work()
        picture = None if found is None else preview_of(found, self._run.store)
        return None if picture is None else picture.path

    def _at_work(self) -> AtWork | None:
        return at_work(self._run.folder, self._run.store)
