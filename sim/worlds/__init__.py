"""Worlds move machines over the ground: PyBullet's rigid bodies, or a fast model of many machines."""
