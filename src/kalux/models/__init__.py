"""Sensor models: event noise (1)-(2) in `events`, camera response and covariance (3)-(9) in `camera`."""
