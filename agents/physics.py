"""Constants of nature that more than one stage uses."""

GRAVITY_MPS2 = 9.81
