"""What tests of several modules share: waiting, sessions, registers. No test is in here."""
