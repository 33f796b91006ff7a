from __future__ import annotations
from dataclasses import dataclass
import numpy as np
from octoreplay.registration.own_map import FREE, MAX_BITS

@dataclass(frozen=True)
class Verification:
    num: int
    same: int
    other: int
    contra: int
    ground_num: int
    g_same: int
    g_other: int
    g_contra: int
    per_class: tuple = ()
    @property
    def q(self): return self.same / max(self.num, 1)
    @property
    def q_c(self): return self.contra / max(self.num, 1)
    @property
    def q_g(self): return self.g_same / max(self.ground_num, 1)
    @property
    def L(self):
        l = np.log
        return (self.same * l(.8/.3) + self.other * l(.08/.2) + self.contra * l(.12/.5)
                + .25 * (self.g_same * l(.9/.6) + self.g_other * l(.08/.3) + self.g_contra * l(.02/.1)))

def _count(cells, T, m):
    p = cells.points @ T[:3, :3].T + T[:3, 3]
    lab, near = m.lookup(p)
    bit = np.uint64(1) << (cells.class_ids.astype(np.uint64) - np.uint64(1)) % np.uint64(MAX_BITS)
    same = (near & bit) != 0
    other = (near != 0) & ~same
    contra = (near == 0) & (lab == FREE)
    return same, other, contra

def verify(a, b, T):
    """T maps b to a."""
    Ti = np.linalg.inv(T)
    tot = np.zeros(6, int)
    for cells, X, m in ((b, T, a), (a, Ti, b)):
        for k, part in enumerate((cells.obstacles, cells.ground)):
            s, o, c = _count(part, X, m)
            tot[3*k:3*k+3] += (int(s.sum()), int(o.sum()), int(c.sum()))
    s, o, c, gs, go, gc = map(int, tot)
    return Verification(s + o + c, s, o, c, gs + go + gc, gs, go, gc)
