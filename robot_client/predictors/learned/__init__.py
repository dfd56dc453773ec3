"""Predictors that need a machine learning library; each file imports one library."""
