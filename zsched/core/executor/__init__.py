"""Stage 5: the hand-over from one worker to the next."""
