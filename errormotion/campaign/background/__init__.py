"""Campaigns in separate processes: started, monitored, answered and stopped by other processes."""
