"""Where stereo frames come from, other than a recording on disk: the simulator."""
