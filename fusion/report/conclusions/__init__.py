"""What a run concludes and what to do next, in the sentences that report, terminal and exports share."""
