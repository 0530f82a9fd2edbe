"""Reports of many runs: of a campaign, a folder, or named recordings."""
