"""Equations of one source of evidence, and what they say of the machines once the ground in them is eliminated.

An equation is `A x + B y = b` with a standard deviation: x the parameters of the machines, y what the source alone does
not know of the ground. Sources share no y, so that what they say of x adds up:

    information = A' W A - A' W B (B' W B)^-1 B' W A        (the Schur complement), and likewise its vector.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from protocol.arrays import Floats, Ints

FAINT = 1e-9  # weight per unit of the diagonal: ground that nothing ties down stays at 0, and pulls on nothing


@dataclass
class Equations:
    """n equations. A: (n, parameters), B: (n, unknowns of the ground), b and std: (n,). tuning: of robust weights.

    weights (n,): of the last round. y: the ground that fits best.
    """

    A: sp.csr_matrix
    B: sp.csr_matrix
    b: Floats
    std: Floats
    y: Floats = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Information:
    """What a source says of the parameters: matrix (p, p), vector (p,) = matrix @ parameters."""

    matrix: Floats
    vector: Floats


def sparse(rows: int, columns: int, *terms: tuple[Ints, Floats]) -> sp.csr_matrix:
    """Matrix with one entry per row and term: (column of each row, value of each row)."""
    row = np.tile(np.arange(rows), len(terms))
    column = np.concatenate([np.zeros(0, np.int64), *(np.broadcast_to(c, rows) for c, _ in terms)])
    value = np.concatenate([np.zeros(0), *(np.broadcast_to(v, rows) for _, v in terms)])
    return sp.csr_matrix((value, (row, column)), shape=(rows, columns))


def eliminate(equations: Equations, weights: Floats) -> tuple[Information, object]:
    """Information of equations with weights (n,) in place of 1 / std^2; and what `ground` needs."""
    A, B = equations.A, equations.B
    WA = A.multiply(weights[:, None]).tocsr()
    AA = (A.T @ WA).toarray()
    Ab = A.T @ (weights * equations.b)
    if not B.shape[1]:
        return Information(AA, Ab), None
    WB = B.multiply(weights[:, None]).tocsr()
    BB = (B.T @ WB).tocsc()
    BB = BB + sp.diags(FAINT * np.maximum(BB.diagonal(), 1.0))
    solver = splu(BB.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0)
    BA = (B.T @ WA).tocsr()
    Bb = B.T @ (weights * equations.b)
    X = solver.solve(BA.toarray())
    y0 = solver.solve(Bb)
    return Information(AA - BA.T @ X, Ab - BA.T @ y0), (y0, X)


def ground(eliminated: object, x: Floats) -> Floats:
    """The ground that fits best with these parameters."""
    if eliminated is None:
        return np.zeros(0)
    y0, X = eliminated  # type: ignore[misc]
    return y0 - X @ x


def residuals(equations: Equations, x: Floats) -> Floats:
    """Residuals (n,) in standard deviations."""
    out = equations.b - equations.A @ x
    if equations.B.shape[1]:
        out = out - equations.B @ equations.y
    return out / equations.std
