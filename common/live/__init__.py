"""The page `/live`: what it gets, its files, and the HTTP of a robot. It knows neither robot nor server."""
