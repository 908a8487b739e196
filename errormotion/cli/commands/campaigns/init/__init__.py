"""``errormotion init``: a bench and a campaign for the instruments at hand."""
