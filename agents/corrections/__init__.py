"""Corrections of a base station for receivers: RTCM3 from a base or a caster, over Zenoh, to the receivers' ports."""
