"""Many clouds to one map: pairs are asked, their poses checked against one another, and all laid together."""
