"""Base station corrections for receivers: RTCM3 from a base or caster, over Zenoh, to receiver ports."""
