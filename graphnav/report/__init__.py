"""Pages for people: reports, comparisons, detections, and the figures in them."""
