"""The plan of the planning page: kept states, reports of them and exported surfaces."""
