"""Feature tracks, keyframes and IMU preintegration; see docs/architecture.md."""
