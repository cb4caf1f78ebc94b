"""What a recording tells about its own cameras: thresholds, delay, noise, response, rigs of two cameras."""
