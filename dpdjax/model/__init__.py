"""What the matter is: pair laws, terms, fluids, units. Imports nothing of the engine."""
