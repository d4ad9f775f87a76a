"""One agreed value: ballots, promises and acceptances, and the two kinds of values that they agree on."""
