"""What is to be done: the data, what is known beforehand, and the truth to compare with."""
