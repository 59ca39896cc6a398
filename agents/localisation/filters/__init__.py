"""The filters, as mathematics: state, belief, motion, EKF, UKF, and a history for late measurements."""
