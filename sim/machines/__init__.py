"""Kinds of machines: bodies, joints and weights, and how steering and engine respond."""
