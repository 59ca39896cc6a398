"""Kinds of machines: bodies, joints, masses, response of steering and engine."""
