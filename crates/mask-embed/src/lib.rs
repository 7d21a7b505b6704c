//! Stage 0: SAM masks and CLIP features of photographs through ONNX.
