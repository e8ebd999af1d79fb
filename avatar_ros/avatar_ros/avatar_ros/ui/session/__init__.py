"""State and requests of the planning page: periods, choices, requests, recordings, texts."""
