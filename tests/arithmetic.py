"""Rounding of this processor: recorded bytes are only reproducible where it is the same."""

import hashlib

import cv2
import numpy as np

ARITHMETIC = "9715b098e465175b4f20a63659fb9f9c4097a7be04f0a7e2a5d3b8211950ab71"  # of the published hashes


def arithmetic() -> str:
    """Hash of the rounding: numpy, OpenBLAS and OpenCV choose kernels by processor.

    OPENBLAS_CORETYPE overrides the choice; some kernels sum vector-matrix products in another order.
    """
    at = np.random.default_rng(1).standard_normal(1001)
    matrix = at[:900].reshape(100, 3, 3)
    values = [np.sin(at), np.cos(at), np.tan(at), np.arctan2(at, at[::-1]), np.exp(at), np.tanh(at), np.hypot(at, 1.0)]
    values += [matrix @ matrix, matrix @ at[:3], at @ at, np.arcsin(np.tanh(at)), np.arctanh(np.tanh(at))]
    values += [np.array([part.T @ at[:3] for part in matrix]), at[:30] @ at[:900].reshape(30, 30)]
    values += [np.array([at[i : i + 3] @ at[i + 1 : i + 4] for i in range(100)])]
    values += [cv2.GaussianBlur(at[:900].reshape(30, 30), (0, 0), 4.8), np.fft.fft(at).real]
    return hashlib.sha256(b"".join(np.ascontiguousarray(value).tobytes() for value in values)).hexdigest()
