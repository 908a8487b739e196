"""What is done against the errors: models that predict them."""
