"""Roads that the evidence shows, and what driving on them costs."""
