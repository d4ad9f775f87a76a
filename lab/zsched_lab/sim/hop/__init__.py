"""Numbered hops on a bad way: the real senders and receivers, everything between them simulated, by seed."""
