"""Equations of one source of evidence, and their information once the ground is eliminated.

An equation is `A x + B y = b` with a standard deviation: x parameters of machines, y the source's unknowns of the
ground. Sources share no y, so information about x adds up:

    information = A' W A - A' W B (B' W B)^-1 B' W A        (the Schur complement), and likewise its vector.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from protocol.arrays import Bools, Floats, Ints

HUBER = 1.5  # standard deviations from which cost is linear, not square
FAINT = 1e-9  # relative weight that holds undetermined ground at 0
AT_ONCE = 64  # columns solved at a time: 4 MB for 8000 cells
NO_GROUND: Floats = np.zeros(0)
Column = tuple[Ints | int, Floats | float]  # of each row: column and value


@dataclass(frozen=True)
class Equations:
    """n equations. A: (n, parameters), B: (n, unknowns of the ground), b and std: (n,).

    heavy (n,): Cauchy's tails, unbent by outliers, not Huber's. blocks: size of coupled unknowns: 1, 2 (k and k +
    half), 0 for any.
    """

    A: sp.csr_matrix
    B: sp.csr_matrix
    b: Floats
    std: Floats
    heavy: Bools
    blocks: int = 1

    def residuals(self, x: Floats, y: Floats) -> Floats:
        """Residuals (n,) in standard deviations."""
        out: Floats = (self.b - self.A @ x - self.B @ y) / self.std
        return out

    def weights(self, x: Floats, y: Floats | None) -> Floats:
        """Weights (n,) of iteratively reweighted least squares; y: None at first."""
        if y is None:
            return 1 / self.std**2
        size = np.abs(self.residuals(x, y))
        robust = np.where(self.heavy, 1 / (1 + size**2), np.minimum(1.0, HUBER / np.maximum(size, HUBER)))
        out: Floats = robust / self.std**2
        return out

    def on(self, y: Floats) -> Equations:
        """The same on known ground; drops NaN."""
        b = self.b - self.B @ y
        known = np.flatnonzero(np.isfinite(b))
        return Equations(self.A[known], self.B[known][:, :0], b[known], self.std[known], self.heavy[known], self.blocks)


@dataclass(frozen=True)
class Information:
    """Information on x: matrix (p, p), vector (p,) = matrix @ best x. ground: best y given x."""

    matrix: Floats
    vector: Floats
    ground: Callable[[Floats], Floats]


def equations(A: sp.csr_matrix, B: sp.csr_matrix | None, b: Floats, std: Floats, blocks: int = 1) -> Equations:
    """Equations with Huber's tails; B: None for no ground."""
    return Equations(A, sp.csr_matrix((len(b), 0)) if B is None else B, b, std, np.zeros(len(b), np.bool_), blocks)


def sparse(rows: int, columns: int, *terms: Column) -> sp.csr_matrix:
    """Matrix with one entry per row and term."""
    row = np.tile(np.arange(rows), len(terms))
    column = np.concatenate([np.zeros(0, np.int64), *(np.broadcast_to(term[0], rows) for term in terms)])
    value = np.concatenate([np.zeros(0), *(np.broadcast_to(term[1], rows) for term in terms)])
    return sp.csr_matrix((value, (row, column)), shape=(rows, columns))


def stacked(*parts: Equations) -> Equations:
    """Stack equations of the same unknowns."""
    A, B = (sp.vstack([getattr(part, name) for part in parts]).tocsr() for name in ("A", "B"))
    b, std, heavy = (np.concatenate([getattr(part, name) for part in parts]) for name in ("b", "std", "heavy"))
    return Equations(A, B, b, std, heavy, parts[0].blocks)


def eliminate(eq: Equations, weights: Floats) -> Information:
    """Eliminate the ground; weights (n,)."""
    W = sp.diags(weights)
    WA = W @ eq.A
    AA, Ab = (eq.A.T @ WA).toarray(), WA.T @ eq.b
    if not eq.B.shape[1]:
        return Information(AA, Ab, lambda _: NO_GROUND)
    BA, Bb, BB = (eq.B.T @ WA).tocsr(), eq.B.T @ (weights * eq.b), eq.B.T @ (W @ eq.B)
    BB += sp.diags(FAINT * np.maximum(BB.diagonal(), 1.0))
    if eq.blocks:
        inverse = _block_inverse(BB.tocsr(), eq.blocks)
        matrix, vector = AA - (BA.T @ (inverse @ BA)).toarray(), Ab - BA.T @ (inverse @ Bb)
        return Information(matrix, vector, lambda x: np.asarray(inverse @ (Bb - BA @ x), np.float64))
    factors = splu(BB.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0)
    columns = BA.tocsc()
    for first in range(0, eq.A.shape[1], AT_ONCE):
        some = slice(first, first + AT_ONCE)
        AA[:, some] -= BA.T @ factors.solve(columns[:, some].toarray())
    return Information(AA, Ab - BA.T @ factors.solve(Bb), lambda x: np.asarray(factors.solve(Bb - BA @ x), np.float64))


def _block_inverse(matrix: sp.csr_matrix, blocks: int) -> sp.csr_matrix:
    """Of a symmetric matrix with blocks of one unknown, or two (k and k + half)."""
    if blocks == 1:
        return sp.diags(1 / matrix.diagonal()).tocsr()
    n = matrix.shape[0] // 2
    diagonal, beside = matrix.diagonal(), matrix.diagonal(n)
    determinant = diagonal[:n] * diagonal[n:] - beside**2
    own = np.concatenate([diagonal[n:], diagonal[:n]]) / np.tile(determinant, 2)
    return sp.diags([own, -beside / determinant, -beside / determinant], [0, n, -n]).tocsr()
