"""The local web application: its screens set a campaign up, run it, and show results, each by public functions of other packages."""
