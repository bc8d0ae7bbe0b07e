"""The paper beside its reproduction: what it reports, and what the tables of the studies say."""
