//! Files of the pipeline: one-line errors, atomic writes, content hashes, npy, safetensors artifacts.
