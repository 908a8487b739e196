"""Text files as datasets: logs of a lab, readings as CSV."""
