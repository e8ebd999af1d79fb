"""Server of the planning page: access, pace of messages to a browser, and the index page."""
