"""Where the machine is, with an honest covariance: dead reckoning, alignment of the start heading, UKF."""
