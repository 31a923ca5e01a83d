"""How the matter starts: beads placed, spheres packed, suspensions and marbles; the engine knows
nothing of it."""
