"""The control bus: beats, profiles, questions and votes over zenoh."""
