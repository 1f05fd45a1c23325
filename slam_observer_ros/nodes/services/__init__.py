"""Services and topics by which others steer the observer."""
