"""Many problems on all devices there are."""
