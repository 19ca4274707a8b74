"""Where the scenery stands."""
