"""The networks that the paper compares itself with, on the same encoder and decoder: each a description and a loss."""
