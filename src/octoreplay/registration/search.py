"""Search for planar poses."""
from __future__ import annotations
import numpy as np
from scipy import fft

E = 0.2

def weights(a, b):
    """(K,K) table over codes 0..K-1 (0 unknown -> 0)."""
    K = 1 + 2 * a.num_classes
    na = np.bincount(a.columns.ravel(), minlength=K)[1:].astype(float)
    nb = np.bincount(b.columns.ravel(), minlength=K)[1:].astype(float)
    P = (na / na.sum() + nb / nb.sum()) / 2
    return P

def table(P):
    K = P.size + 1
    W = np.full((K, K), np.log(E), np.float32)
    W[0, :] = 0; W[:, 0] = 0
    with np.errstate(divide="ignore"):
        d = np.log((1 - E) / np.maximum(P, 1e-4) + E)
    W[np.arange(1, K), np.arange(1, K)] = d
    return W

def column_points(m):
    """centres (n,2) [m] and codes."""
    ij = np.argwhere(m.columns > 0)
    pts = (ij + m.column_low + 0.5) * 2 * m.resolution
    return pts, m.columns[ij[:, 0], ij[:, 1]].astype(np.int64)

class Coarse:
    """coarse layers of a map for FFT: factor 2 columns -> nearest scatter counts."""

def correlate(a, b, W, num_yaws=72, peaks=3, keep=40):
    G = 4 * a.resolution
    pa, ca = column_points(a)
    pb, cb = column_points(b)
    K = W.shape[0]
    used = np.intersect1d(np.unique(ca), np.unique(cb))
    ia = np.floor(pa / G).astype(int); oa = ia.min(0); ia -= oa
    rb = np.abs(pb - pb.mean(0)).max() * 1.5
    mb = pb.mean(0)
    r = np.sqrt(((pb - mb) ** 2).sum(1)).max()
    nb = int(np.ceil(2 * r / G)) + 2
    shape = [fft.next_fast_len(int(ia[:, k].max()) + 1 + nb, real=True) for k in (0, 1)]
    def layers(ij, codes):
        n = shape[0] * shape[1]
        flat = ij[:, 0] * shape[1] + ij[:, 1]
        count = np.bincount(flat, minlength=n).astype(np.float32)
        out = np.empty((len(used) + 1, n), np.float32)
        inv = 1 / np.maximum(count, 1)
        for k, u in enumerate(used):
            out[k] = np.bincount(flat[codes == u], minlength=n) * inv
        out[-1] = count > 0
        return out.reshape(-1, *shape)
    FA = fft.rfft2(layers(ia, ca))
    lw = np.log(E)
    w = np.append(W[used, used] - lw, lw).astype(np.float32)
    FA = np.conj(FA) * w[:, None, None]
    found = []
    for y in range(num_yaws):
        th = 2 * np.pi * y / num_yaws
        c, s = np.cos(th), np.sin(th)
        R = np.array([[c, -s], [s, c]])
        q = (pb - mb) @ R.T
        ib = np.floor((q + r) / G).astype(int)
        FB = fft.rfft2(layers(ib, cb))
        # corr[d] = sum_x A[x] B[x + d]
        S = fft.irfft2((FA * FB).sum(0), s=shape)
        S = S.copy()
        for _ in range(peaks):
            k = int(S.argmax()); d = np.array(divmod(k, shape[1]))
            val = S[d[0], d[1]]
            dd = (d + nb) % np.array(shape) - nb  # d in [-nax, nb)
            dd = np.where(d < nb, d, d - np.array(shape))
            # x_b = x_a + d: a coord = (ia+oa)*G ; b rotated coord = ib*G - r ; t = a - R(b - mb)
            t = (-dd + oa) * G + r
            t = t - R @ mb
            found.append((val, th, *t))
            S[np.ix_((d[0] + np.arange(-2, 3)) % shape[0], (d[1] + np.arange(-2, 3)) % shape[1])] = -np.inf
    found.sort(key=lambda f: -f[0])
    return found[:keep]

def score(a, pb, cb, W, th, t):
    """th (h,), t (h,2) -> (h,)"""
    c, s = np.cos(th)[:, None], np.sin(th)[:, None]
    x = c * pb[:, 0] - s * pb[:, 1] + t[:, 0, None]
    y = s * pb[:, 0] + c * pb[:, 1] + t[:, 1, None]
    G = 2 * a.resolution
    i = np.floor(x / G).astype(np.int32) - a.column_low[0]
    j = np.floor(y / G).astype(np.int32) - a.column_low[1]
    cols = a.columns
    ok = (i >= 0) & (i < cols.shape[0]) & (j >= 0) & (j < cols.shape[1])
    code = np.where(ok, cols.ravel()[np.where(ok, i * cols.shape[1] + j, 0)], 0)
    return W[code, cb].sum(1)

def climb(a, b, W, found, steps=((5, 1.2), (2.5, 0.6), (1, 0.3))):
    pb, cb = column_points(b)
    cen = pb.mean(0)
    out = []
    for f in found:
        th, t = f[1], np.array(f[2:4])
        best = score(a, pb, cb, W, np.array([th]), t[None])[0]
        for dth, dt in steps:
            dth = np.deg2rad(dth); dt = dt / 0.3 * a.resolution
            for _ in range(8):
                g = np.array([(u, v, w) for u in (-1, 0, 1) for v in (-1, 0, 1) for w in (-1, 0, 1) if (u, v, w) != (0, 0, 0)], float)
                ths = th + g[:, 0] * dth
                # rotate about b's centre
                c0 = np.array([[np.cos(th), -np.sin(th)], [np.sin(th), np.cos(th)]]) @ cen + t
                ts = c0 - np.stack([np.cos(ths) * cen[0] - np.sin(ths) * cen[1], np.sin(ths) * cen[0] + np.cos(ths) * cen[1]], 1) + g[:, 1:] * dt
                s = score(a, pb, cb, W, ths, ts)
                k = int(s.argmax())
                if s[k] <= best:
                    break
                best, th, t = s[k], ths[k], ts[k]
        out.append((best, th, *t))
    out.sort(key=lambda f: -f[0])
    return out
