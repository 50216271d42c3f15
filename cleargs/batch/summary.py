"""``summary.csv``: one row per scene of a batch."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal

from rich.filesize import decimal

from cleargs.capture.summary import IngestSummary
from cleargs.files import write_bytes
from cleargs.manifest import Manifest
from cleargs.report.formatting import duration
from cleargs.rivr.summaries import TrainingSummary

SUMMARY = "summary.csv"


HEADER = b"scene,state,"
"""Begin of a summary."""


State = Literal["failed", "waiting", "partial", "done"]
"""``waiting``: stages are missing, and the last attempt, if any, reported no error."""


@dataclass(frozen=True)
class Result:
    """State and figures of a scene: a row of ``summary.csv``."""

    scene: str
    state: State
    frames: int | None
    frames_placed: int | None
    psnr_unseen: float | None
    """PSNR of the last scene on pixels that no training saw, in dB."""
    minutes: float
    """Total time of all stages."""
    memory_gb: float
    """Largest peak memory of a stage, GB (1e9 bytes)."""
    disk_gb: float
    """Size of all results, GB (1e9 bytes)."""
    cause: str
    """Cause of the failure, or missing outputs."""

    @classmethod
    def of(cls, scene: str, made: Mapping[str, Manifest], state: State, cause: str) -> Result:
        """Return the row of a scene with the manifests ``made`` of its finished stages."""
        ingest = IngestSummary.of(made.get("ingest"))
        psnr = [TrainingSummary.of(manifest).psnr_unseen for manifest in made.values()]
        return cls(
            scene=scene,
            state=state,
            frames=ingest.frames,
            frames_placed=ingest.registered,
            psnr_unseen=next((value for value in reversed(psnr) if value is not None), None),
            minutes=round(sum(manifest.seconds for manifest in made.values()) / 60, 2),
            memory_gb=max((manifest.peak_memory_gb or 0.0 for manifest in made.values()), default=0.0),
            disk_gb=round(sum(manifest.bytes for manifest in made.values()) / 1e9, 3),
            cause=cause,
        )

    def figures(self) -> list[tuple[str, str]]:
        """Return the known figures as (value, meaning)."""
        found = []
        if self.frames is not None:
            found.append((f"{self.frames_placed} of {self.frames}", "frames placed"))
        if self.psnr_unseen is not None:
            found.append((f"{self.psnr_unseen:.1f} dB", "PSNR on pixels that no training saw"))
        if self.minutes:
            found.append((duration(60 * self.minutes), "of work"))
            found.append((f"{self.memory_gb:.1f} GB", "of memory"))
            found.append((decimal(round(1e9 * self.disk_gb)), "on disk"))
        return found


def write_summary(path: Path, results: Sequence[Result]) -> None:
    """Write one row per scene. Raises StoreError."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(Result)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(result) for result in results)
    write_bytes(path, text.getvalue().encode())
