"""What a campaign will do and how well it will measure, before anything moves."""
