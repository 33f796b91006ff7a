"""Content of an octree at one time, kept while the octree changes."""

from __future__ import annotations

from threading import Lock
from typing import Any

import numpy as np

from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import Int64Array


class Snapshot:
    """Content of ``octree`` as it is now. It shares all bricks with the octree until they change.

    Call ``save`` before bricks of the octree change. Threads may read one snapshot at the same time, but not while its
    octree changes.

    Attributes
    ----------
    saved : SemanticOctree
        Bricks that may have changed since, as they were, with their revisions. Bricks that the octree did not have are
        here without known cells.
    """

    def __init__(self, octree: SemanticOctree) -> None:
        self.saved = SemanticOctree(octree.resolution, octree.num_classes)
        self._source = octree
        self._whole: SemanticOctree | None = None
        self._lock = Lock()

    def __getstate__(self) -> dict[str, Any]:
        """Return the content for ``pickle``."""
        return {name: value for name, value in vars(self).items() if name != "_lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the content from ``pickle``."""
        vars(self).update(state, _lock=Lock())

    def save(self, codes: Int64Array) -> None:
        """Save the bricks ``codes`` (n,) int64, each given once; those that were saved before are skipped."""
        if self._whole is not None:
            return
        fresh = codes[self.saved.find(codes) < 0]
        if not fresh.size:
            return
        indices = self._source.find(fresh)
        here = indices[indices >= 0]
        self.saved.find_or_add(fresh)
        self.saved.overwrite(self._source, here)
        self.saved.revisions[self.saved.find(fresh[indices >= 0])] = self._source.revisions[here]

    @property
    def octree(self) -> SemanticOctree:
        """The whole content: the octree itself while no brick was saved, else a copy. Do not change it."""
        with self._lock:
            if self._whole is None and not self.saved.num_bricks:
                return self._source
            if self._whole is None:
                self._whole = self._source.copy()
                self._whole.overwrite(self.saved, np.arange(self.saved.num_bricks))
                self._whole.revisions[self._whole.find(self.saved.codes)] = self.saved.revisions
                self.saved = SemanticOctree(self._source.resolution, self._source.num_classes)
            return self._whole
