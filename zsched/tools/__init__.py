"""Behind a wall: what no daemon needs. The rest of zsched imports nothing from here."""
