"""Kinds of machines: their bodies, joints and places, what they weigh, and the soils they roll on."""
