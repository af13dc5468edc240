"""2D boxes alone: tracks over images by the odometry, triangulation, and what of it SLAM may take for measured."""
