//! Stage 3: instances from features, instance-to-mask matching, a descriptor per instance.
