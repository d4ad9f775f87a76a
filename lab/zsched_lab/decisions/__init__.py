"""Decision quality offline: the real scoring and stickiness over thousands of simulated hours, against an oracle."""
