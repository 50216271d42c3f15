"""Second pictures of the same views: data sets for deblurring have each as filmed and sharp."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import TypeAlias

_FILMED = r"blur(?:red|ry)?|defocus(?:ed)?|noisy|hazy|degraded|lq"
_TRUE = r"sharp|gt|ground.?truth|targets?|clean|clear|reference|hq"
_WORD = re.compile(rf"(?<![^\W\d_])(?:({_FILMED})|({_TRUE}))(?![^\W\d_])", re.IGNORECASE)

View: TypeAlias = tuple[str | None, ...]
"""The folders and the bare name of a file. None is the folder in which versions differ."""


def second_views(files: Sequence[Path], root: Path) -> list[Path]:
    """Return the files below ``root`` that show views of others, by words in their names or their folders'.

    If names in ``blur/`` and ``sharp/`` are equal (or ``1_blur`` and ``1_sharp`` exist), the files without
    such a word are kept, else those as filmed. A scene of both would mix them, and sharp ones are references.
    A folder is returned as a whole if at least half of its files show views of others.
    """
    versions: dict[View, set[tuple[int, str]]] = defaultdict(set)
    places: dict[Path, list[tuple[View, tuple[int, str], Path]]] = {}
    for path in files:
        *folders, stem = path.relative_to(root).with_suffix("").parts
        bare = _WORD.sub("", stem).strip("-_. ").lower()
        places[path] = [((*folders, bare), (version_rank(stem), stem), path)]
        for depth, name in enumerate(folders):
            view = (*folders[:depth], None, *folders[depth + 1 :], bare)
            places[path].append((view, (version_rank(name), name), root.joinpath(*folders[: depth + 1])))
        for view, version, _ in places[path]:
            versions[view].add(version)
    sizes, second = Counter[Path](), Counter[Path]()
    for view, version, place in chain.from_iterable(places.values()):
        first, last = min(versions[view]), max(versions[view])
        sizes[place] += 1
        second[place] += bool(version[0]) and first < version and first[0] < last[0]
    out = {place for place, count in second.items() if 0 < sizes[place] <= 2 * count}
    return [path for path in files if any(place in out for _, _, place in places[path])]


def version_rank(name: str) -> int:
    """Return 2 for a name with a word of a sharp picture, 1 with one of a picture as filmed, 0 without."""
    words = list(_WORD.finditer(name))
    return max((2 if word[2] else 1 for word in words), default=0)
