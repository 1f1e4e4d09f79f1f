"""Arrays as other programs store them too: zip members (.npz, .pt) and ``.npy``, read without believing what they say.

Errors do not name the file, which is not known here: who opened it does.
"""
