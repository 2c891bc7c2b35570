"""LeRobotDatasets on disk: read, encode, rewrite, appear in one piece."""
