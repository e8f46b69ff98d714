"""Import of other tools' recordings (CSV, MATLAB, bags) as sessions, by a mapping file."""
