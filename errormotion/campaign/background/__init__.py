"""Campaigns that run in a process of their own: started, followed, answered and stopped from elsewhere."""
