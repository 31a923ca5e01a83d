"""How the matter moves: box, flow, noise, neighbours, state, forces, step, simulate."""
