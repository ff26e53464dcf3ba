"""The Implicit LiDAR Network (ICRA 2022): sensors, scans, towns, models, training and evaluation."""
