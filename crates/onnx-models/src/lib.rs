//! ONNX engines, CLIP image and text encoders, the CLIP tokenizer and mask crops.
