"""The sections of the experiment file: settings, rules, warnings and cures of each."""
