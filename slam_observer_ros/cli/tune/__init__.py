"""``slam-observer tune``: noise figures by maximum likelihood of the innovations."""
