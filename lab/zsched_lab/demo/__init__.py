"""`zsched demo`: its run, its screen, its figures."""
