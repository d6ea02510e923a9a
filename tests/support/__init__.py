"""What several tests share: scenes and boards with known truth, renderings, and the command line."""
