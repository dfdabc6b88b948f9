"""Limbs of people by a pose estimator, beside what the depth layer sees: they may only be added to it."""

BACKENDS = {"mediapipe": "asc_rt.perception.pose.backend_mediapipe:MediaPipe"}  # "module:Class", a PoseEstimator
