//! Engines on small models whose results can be computed by hand (scripts/make_onnx_testdata.py makes them).
//!
//! ONNX Runtime is tried too where `ORT_TEST_LIBRARY` names its shared library.

use onnx_models::{EngineOptions, Graph, Kind, Model, Outputs, Tensor, open};
use std::path::{Path, PathBuf};

fn testdata(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata").join(name)
}

/// Options of every engine at hand.
fn engines() -> Vec<EngineOptions> {
    let mut all = vec![EngineOptions::default()];
    match std::env::var_os("ORT_TEST_LIBRARY") {
        Some(library) => all.push(EngineOptions { onnx_runtime: Some(library.into()), ..EngineOptions::default() }),
        None => eprintln!("SKIPPED: ONNX Runtime (set ORT_TEST_LIBRARY and ORT_DISABLE_TELEMETRY=1 to try it)"),
    }
    all
}

const A: [f32; 6] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.5];

fn run_ops(model: &dyn Model, b: Tensor) -> Vec<Tensor<'static>> {
    model.run(&[("b", b), ("a", Tensor::f32(&[2, 3], &A[..]))]).unwrap()
}

#[test]
fn named_inputs_and_outputs_of_either_integer_width() {
    for options in engines() {
        let model = open(testdata("ops.onnx"), Outputs::Declared, &options).unwrap();
        let names: Vec<&str> = model.outputs().iter().map(|o| o.name.as_str()).collect();
        assert_eq!(names, ["sum", "product", "b_twice"]);
        assert_eq!(model.inputs()[1].kind, Some(Kind::Integer));
        assert_eq!((model.inputs()[0].fixed(0), model.inputs()[0].fixed(1)), (None, Some(3)));
        let wide = run_ops(&*model, Tensor::i64(&[2, 3], vec![1, 0, -1, 2, 0, 7]));
        let narrow = run_ops(&*model, Tensor::i32(&[2, 3], vec![1, 0, -1, 2, 0, 7]));
        assert_eq!(wide, narrow);
        assert_eq!(wide[0], Tensor::f32(&[2, 3], vec![2.0, 2.0, 2.0, 6.0, 5.0, 13.5]));
        assert_eq!(wide[1].as_f32().unwrap(), [5.0, 4.0, 3.0, 14.0, 10.0, 34.0]);
        assert_eq!(wide[2].to_i64().unwrap()[..], [2, 0, -2, 4, 0, 14]);
    }
}

#[test]
fn a_value_inside_the_graph_can_be_the_output() {
    for options in engines() {
        let model = open(testdata("ops.onnx"), Outputs::Values(&["twice", "sum"]), &options).unwrap();
        let out = run_ops(&*model, Tensor::i64(&[2, 3], vec![0; 6]));
        assert_eq!(out.len(), 2);
        assert_eq!(out[0].as_f32().unwrap(), [2.0, 4.0, 6.0, 8.0, 10.0, 13.0]);
        assert_eq!(out[1].as_f32().unwrap(), A);
        let e = open(testdata("ops.onnx"), Outputs::Values(&["thrice"]), &options).err().unwrap().to_string();
        assert!(e.contains("thrice: the model has no such value") && e.contains("sum, product"), "{e}");
    }
}

#[test]
fn what_an_output_does_not_need_is_left_out() {
    let bytes = std::fs::read(testdata("ops.onnx")).unwrap();
    let whole = Graph::parse(&bytes).unwrap();
    let part = Graph::parse(&whole.with_outputs(&bytes, &["twice"]).unwrap()).unwrap();
    assert!(whole.producers.contains_key("product") && !part.producers.contains_key("product"));
    assert_eq!(part.producers["twice"], whole.producers["twice"]);
}

#[test]
fn the_end_of_a_text_is_found_alike_where_it_is_filled_with_zeros() {
    for options in engines() {
        let model = open(testdata("argmax.onnx"), Outputs::Declared, &options).unwrap();
        let end = |ids: [i32; 10]| {
            let out = model.run(&[("ids", Tensor::i32(&[2, 5], ids.to_vec()))]).unwrap().remove(0);
            out.to_i64().unwrap().to_vec()
        };
        assert_eq!(end([49406, 320, 49407, 0, 0, 49406, 49407, 0, 0, 0]), [2, 1]);
        // Of equals ONNX says the first. rten 0.27 takes the last, so no text may be filled with its end mark.
        let ties = end([49406, 320, 49407, 49407, 49407, 49406, 49407, 49407, 49407, 49407]);
        assert!(ties == [2, 1] || options.onnx_runtime.is_none() && ties == [4, 4], "{ties:?}");
    }
}

#[test]
fn inputs_that_do_not_fit_are_named() {
    for options in engines() {
        let model = open(testdata("ops.onnx"), Outputs::Declared, &options).unwrap();
        let a = || ("a", Tensor::f32(&[2, 3], &A[..]));
        let b = |shape: &[usize]| ("b", Tensor::i64(shape, vec![0; 6]));
        let error = |inputs: &[(&str, Tensor)]| {
            let e = model.run(inputs).unwrap_err().to_string();
            assert!(e.contains("ops.onnx: input ") && !e.contains('\n'), "{e}");
            e
        };
        assert!(error(&[a()]).contains("input b: the model has an input that this program does not know"));
        assert!(
            error(&[a(), b(&[2, 3]), ("c", Tensor::i32(&[1], vec![0]))]).contains("input c: the model has no such")
        );
        let e = error(&[a(), b(&[3, 2])]);
        assert!(
            e.contains("input b: the input has another shape; found [any, 3] in the model, expected [3, 2]"),
            "{e}"
        );
        assert!(error(&[a(), b(&[6])]).contains("another shape"));
        assert!(error(&[a(), b(&[3, 3])]).contains("found 6 values, expected [3, 3]"));
        let e = error(&[a(), ("b", Tensor::f32(&[2, 3], &A[..]))]);
        assert!(e.contains("found integers, expected floats"), "{e}");
        // Rows that differ between inputs are only seen by the engine.
        let e = model.run(&[a(), ("b", Tensor::i64(&[5, 3], vec![0; 15]))]).unwrap_err().to_string();
        assert!(e.contains("cannot run the model"), "{e}");
    }
}

#[test]
fn files_that_are_no_models_are_one_line_errors() {
    let dir = tempfile::tempdir().unwrap();
    let whole = std::fs::read(testdata("ops.onnx")).unwrap();
    for options in engines() {
        let e = open(dir.path().join("none.onnx"), Outputs::Declared, &options).err().unwrap().to_string();
        assert!(e.contains("none.onnx: cannot read"), "{e}");
        let p = dir.path().join("damaged.onnx");
        let pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 5\n".to_vec();
        for bytes in [vec![], pointer, whole[..whole.len() / 2].to_vec(), vec![0xff; 200]] {
            std::fs::write(&p, &bytes).unwrap();
            let e = open(&p, Outputs::Declared, &options).err().expect("damaged").to_string();
            assert!(e.contains("damaged.onnx: ") && !e.contains('\n'), "{e}");
        }
        // Any cut and any flipped byte: an error or a model, never a panic.
        for at in 0..whole.len() {
            std::fs::write(&p, &whole[..at]).unwrap();
            let _ = open(&p, Outputs::Declared, &options);
            let mut flipped = whole.clone();
            flipped[at] ^= 0x5a;
            std::fs::write(&p, &flipped).unwrap();
            let _ = open(&p, Outputs::Values(&["sum"]), &options);
        }
    }
}

#[test]
fn a_library_that_is_not_onnx_runtime_is_an_error() {
    let options = |path: &str| EngineOptions { onnx_runtime: Some(path.into()), ..EngineOptions::default() };
    let e = open(testdata("ops.onnx"), Outputs::Declared, &options("/no/such/libonnxruntime.so")).err().unwrap();
    let e = e.to_string();
    assert!(e.starts_with("/no/such/libonnxruntime.so: --onnx-runtime: ") && !e.contains('\n'), "{e}");
}
