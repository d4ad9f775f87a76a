"""The data-plane process: streams rewritten by route plans (``python -m zsched.relay``, a child of the daemon)."""
