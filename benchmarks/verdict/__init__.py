"""The verdict on raw clouds, fitted by folds over places on pairs made here."""
