"""Object SLAM keyframe by keyframe."""
