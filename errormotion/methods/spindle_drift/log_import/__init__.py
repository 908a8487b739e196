"""Import of logs of a drift with a map of the schema ``errormotion.map/1``."""
