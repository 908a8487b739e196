"""Parts that several chapters share: beams, budget, temperature sensors."""
