"""What an operation may assume: tensors, numbers and units are checked once, whichever body computes."""
