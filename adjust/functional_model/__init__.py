"""The functions of observations and their derivatives: from the object through camera and film to the comparator."""
