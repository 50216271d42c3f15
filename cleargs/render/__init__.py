"""Images and films of a finished scene: camera paths and output files; and its export."""

from collections.abc import Mapping
from typing import NamedTuple


class Target(NamedTuple):
    """The file that a program reads best, and the steps that are left to the user."""

    ending: str
    up: str | None
    sh_degree: int | None
    """Readers for Blender and the game engines expect harmonics of degree 3."""
    hint: str
    spz: int = 3
    """Version of an .spz."""


TARGETS: Mapping[str, Target] = {
    "blender": Target("ply", "z", 3, "z up; in Blender 5.3 File > Import > PLY, view transform Standard"),
    "unreal": Target("ply", None, 3, "axes as trained; import it with a 3DGS plug-in, which turns them"),
    "unity": Target("ply", "y", 3, "y up; in UnityGaussianSplatting set Scale to 1, 1, -1"),
    "supersplat": Target("sog", None, None, "axes as trained; drop the file on the page"),
    "web": Target("spz", "y", None, "y up; in Spark, Babylon and three.js add it without a rotation"),
    "playcanvas": Target("spz", "y", None, "y up; add it without a rotation, with the engine's SpzParser", 4),
}
"""Program of ``cleargs export --for`` -> its file."""
