"""Results of an evaluation: ``eval.json``, and a Parquet table of the same figures."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
from pydantic import ConfigDict, Field, ValidationError

from cleargs.base_model import FrozenModel
from cleargs.errors import InputError
from cleargs.evaluate.config import EvalOptions
from cleargs.files import disk_errors, write_json
from cleargs.parquet import column, write_table
from cleargs.safe_io import read_bytes

PosesFrom = Literal["reference", "given"]

_MEANINGS = {
    "psnr": "dB, of the mean squared error of an image; higher is better",
    "ssim": "Gaussian window 11, sigma 1.5, border mirrored; higher is better",
    "lpips_alex": "LPIPS v0.1, AlexNet; lower is better",
    "lpips_vgg": "LPIPS v0.1, VGG16; lower is better",
}
_SCORE = "no-reference score; higher is better"

_REGIONS = {
    "far": "in which the scene shows something behind all sparse points of the view, or nothing",
    "clipped": "with a channel of the reference of at least 254",
}

LOWER_IS_BETTER = frozenset({"lpips_alex", "lpips_vgg"})
"""Metrics whose lower values are better; of all others the higher values are."""


class Figures(FrozenModel):
    """A record whose JSON writes infinite numbers as ``"Infinity"``, because JSON has no such number.

    The PSNR of a perfect image is infinite. Read from JSON, it is a number again.
    """

    model_config = ConfigDict(ser_json_inf_nan="strings")


class Region(Figures):
    """A part of one image, or of all images."""

    share: float = Field(ge=0, le=1, description="Share of the pixels that count.")
    psnr: float | None = Field(description="dB, of its mean squared error; null if it is empty.")


class Alignment(Figures):
    """Transformation of the reference's poses into the scene's world."""

    world: Literal["scene", "ingest", "umeyama"] = Field(
        description="scene: none; ingest: the similarity of ingest; umeyama: a fit to the cameras of frames "
        "with the same stems, because the run's poses are not those of the input."
    )
    matched: int = Field(ge=0, description="Number of references with the stem of a registered frame.")
    residual: float | None = Field(
        None, ge=0, description="RMS distance of fitted centres, as a share of the trajectory's extent."
    )
    rotation_deg: float | None = Field(
        None, ge=0, description="Mean angle between fitted and actual orientations, degrees."
    )


class Refinement(Figures):
    """Changes of one view by pose refinement."""

    rotation_deg: float = Field(ge=0, description="Angle turned, degrees.")
    shift: float = Field(ge=0, description="Distance that the camera centre moved, in the scene's units.")
    loss_before: float = Field(ge=0, description="Mean squared difference at full size, before.")
    loss_after: float = Field(ge=0, description="Mean squared difference at full size, after.")


class ImageResult(Figures):
    """The figures of one image."""

    name: str = Field(description="Stem of the reference's file.")
    width: int = Field(ge=1, description="Pixels.")
    height: int = Field(ge=1, description="Pixels.")
    values: dict[str, float | None] = Field(description="Metric -> value; null if it is unavailable.")
    prediction: str = Field(description="SHA-256 of the evaluated 8-bit pixels.")
    reference: str = Field(description="SHA-256 of the reference's 8-bit pixels, and of its mask.")
    colour: tuple[tuple[float, ...], ...] | None = Field(
        None, description="The affine [3, 4] on sRGB that colour alignment applied."
    )
    psnr_colour_aligned: float | None = Field(
        None, description="dB, after the colours were fitted to the reference by an affine on sRGB."
    )
    psnr_white: float | None = Field(
        None, description="dB, of the scene over white instead of its background; null for finished images."
    )
    psnr_between: float | None = Field(
        None, description="dB, between the scene over its background (black unless set) and over white."
    )
    refinement: Refinement | None = Field(None, description="Changes by pose refinement.")
    far: Region | None = Field(
        None,
        description="Pixels in which the scene shows something behind all sparse points of the view, or "
        "nothing; null if these are not known.",
    )
    clipped: Region | None = Field(
        None, description="Pixels with a channel of the reference of at least 254."
    )
    covered: float | None = Field(
        None,
        description="Share of the image that Gaussians in front of the true surface cover; null where the "
        "reference has no depth.",
    )
    formed: dict[str, float | None] = Field(
        {},
        description="Metric -> value of the scene as its camera took the frame: with the measured motion "
        "during the readout, and during the exposure time of the training's frames; empty where none was "
        "measured.",
    )


class Evaluation(Figures):
    """One scene, or one folder of images, against one reference."""

    subject: str = Field(description="The stage, or the name of the scene file or of the folder of images.")
    scene: str | None = Field(description="SHA-256 of the scene file; null for a folder of images.")
    reference: str = Field(description="Name of the reference folder, or holdout.")
    split: str = Field(description="SHA-256 over the sorted stems and the digests of the references.")
    poses: PosesFrom = Field(description="Whose poses are rendered: the reference's, or the run's own.")
    alignment: Alignment
    options: EvalOptions
    means: dict[str, float | None] = Field(description="Metric -> mean over the images.")
    psnr_colour_aligned: float | None = Field(
        None, description="Mean of `psnr_colour_aligned` over the images; null if `align_colour` is set."
    )
    psnr_white: float | None = Field(None, description="Mean of `psnr_white` over the images.")
    psnr_between: float | None = Field(None, description="Mean of `psnr_between` over the images.")
    far: Region | None = Field(None, description="`far` over all images; PSNR of its mean squared error.")
    clipped: Region | None = Field(None, description="`clipped` over all images, likewise.")
    covered: float | None = Field(None, description="Mean of `covered` over the images.")
    formed: dict[str, float | None] = Field({}, description="Metric -> mean of `formed` over the images.")
    unavailable: dict[str, str] = Field(description="Metric -> why it is null.")
    weights: dict[str, str] = Field(description="Metric -> digest of the weights behind it.")
    trained_on: int | None = Field(
        None,
        ge=0,
        description="Number of the images that show frames of the scene's training; null: not known.",
    )
    versions: dict[str, str]
    images: tuple[ImageResult, ...]


class Report(Figures):
    """``eval.json``: evaluations against one reference, one per stage."""

    schema_version: Literal[1] = 1
    evaluations: tuple[Evaluation, ...]

    def merged_with(self, older: Report) -> Report:
        """Return these evaluations, then those of ``older`` on the same references that are not replaced."""
        here = {(found.subject, found.poses, found.options) for found in self.evaluations}
        splits = {found.split for found in self.evaluations}
        kept = [
            found
            for found in older.evaluations
            if found.split in splits and (found.subject, found.poses, found.options) not in here
        ]
        return Report(evaluations=(*self.evaluations, *kept))

    def document(self) -> dict[str, Any]:
        """Return the report as JSON values."""
        document: dict[str, Any] = json.loads(self.model_dump_json())
        return document


def mean_of(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are not None; None if all are."""
    present = [value for value in values if value is not None]
    return math.fsum(present) / len(present) if present else None


def split_hash(references: Mapping[str, str]) -> str:
    """Return the SHA-256 over the sorted stems and their references' digests, which names a test set."""
    lines = "".join(f"{stem} {digest}\n" for stem, digest in sorted(references.items()))
    return hashlib.sha256(lines.encode()).hexdigest()


def write_report(path: Path, report: Report) -> None:
    """Write ``path`` (.json) and the table next to it (.parquet). Raises StoreError."""
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, report.document())
    metrics = dict.fromkeys(metric for found in report.evaluations for metric in found.options.metrics)
    schema = table_schema(tuple(metrics))
    rows = [_row(found, image) for found in report.evaluations for image in found.images]
    write_table(path.with_suffix(".parquet"), pa.Table.from_pylist(rows, schema), schema)


def read_report(path: Path) -> Report:
    """Read a file of `write_report`. Raises InputError if it is missing or damaged."""
    try:
        return Report.model_validate_json(read_bytes(path, root=path.parent))
    except (OSError, ValidationError) as error:
        raise InputError(
            f"cannot read {path}: {str(error).splitlines()[0]}", hint="choose another file of `cleargs eval`"
        ) from error


def table_schema(metrics: Sequence[str]) -> pa.Schema:
    """Return the columns of the Parquet table: one row per image, one column per metric."""
    return pa.schema(
        [
            column("subject", pa.string(), "stage, or name of the scene file or of the folder of images"),
            column("adjusted", pa.string(), "fitted to the reference first: colours, poses, or nothing"),
            column("name", pa.string(), "stem of the reference's file"),
            column("width", pa.int32(), "px"),
            column("height", pa.int32(), "px"),
            *(column(name, pa.float64(), _MEANINGS.get(name, _SCORE), nullable=True) for name in metrics),
            *(
                column(f"{region}_{figure}", pa.float64(), words, nullable=True)
                for region, where in _REGIONS.items()
                for figure, words in (("share", f"of pixels {where}"), ("psnr", f"dB, of pixels {where}"))
            ),
            column(
                "psnr_colour_aligned", pa.float64(), "dB, colours aligned to the reference", nullable=True
            ),
            column("psnr_white", pa.float64(), "dB, of the scene over white", nullable=True),
            column("psnr_between", pa.float64(), "dB, between background and white", nullable=True),
            column("covered", pa.float64(), "share of the image that floaters cover", nullable=True),
            *(
                column(f"formed_{name}", pa.float64(), "the same as the camera took the frame", nullable=True)
                for name in metrics
            ),
            column("prediction", pa.string(), "SHA-256 of the evaluated 8-bit pixels"),
            column("reference", pa.string(), "SHA-256 of the reference's 8-bit pixels, and of its mask"),
            column("colour", pa.list_(pa.float64()), "affine 3x4 on sRGB, row by row", nullable=True),
            column("refined_rotation_deg", pa.float64(), "rotation by refinement, degrees", nullable=True),
            column(
                "refined_shift", pa.float64(), "movement of the camera centre, scene units", nullable=True
            ),
        ]
    )


def _row(evaluation: Evaluation, image: ImageResult) -> dict[str, Any]:
    """Return the columns of one image; the others of the table are null."""
    options = evaluation.options
    fitted = ["colours"] if options.align_colour else []
    fitted += [f"poses in {options.refine_poses} steps"] if options.refine_poses else []
    row = {
        "subject": evaluation.subject,
        "adjusted": ", ".join(fitted) or "nothing",
        **dict(image),
        **image.values,
        **{f"formed_{name}": value for name, value in image.formed.items()},
        "colour": None if image.colour is None else [x for line in image.colour for x in line],
    }
    for name, part in {"far": image.far, "clipped": image.clipped, "refined": image.refinement}.items():
        row |= {f"{name}_{figure}": value for figure, value in part or ()}
    return row
