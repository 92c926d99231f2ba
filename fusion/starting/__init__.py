"""Before a run: what files hold, a campaign file for a folder, and every check of a campaign that needs no long work."""
