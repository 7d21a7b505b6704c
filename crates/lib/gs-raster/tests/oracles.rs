//! Renderings and gradients of independent implementations.

use glam::{DMat3, DVec3};
use gs_raster::{PixelGradients, RasterOptions, Workspace, render};
use gs_scene::{Camera, Gaussians};
use std::collections::HashMap;
use std::io::Read;
use std::path::PathBuf;

fn data(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../../shared/data/oracle").join(name)
}

fn triples<const K: usize>(v: &[f32]) -> Vec<[f32; K]> {
    v.chunks_exact(K).map(|c| c.try_into().unwrap()).collect()
}

fn worst(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max)
}

/// |a - b| / |b| in the Euclidean norm.
fn relative(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let norm = |v: &mut dyn Iterator<Item = f64>| v.map(|x| x * x).sum::<f64>().sqrt();
    let difference = norm(&mut a.iter().zip(b).map(|(x, y)| f64::from(*x) - f64::from(*y)));
    difference / norm(&mut b.iter().map(|x| f64::from(*x)))
}

#[test]
#[ignore = "needs shared/data/oracle; run make test-data"]
fn matches_gsplat_on_the_gpu() {
    for name in ["tiny_case", "basic_case"] {
        let bytes = std::fs::read(data(&format!("{name}.safetensors"))).unwrap();
        let t = safetensors::SafeTensors::deserialize(&bytes).unwrap();
        let get = |n: &str| -> Vec<f32> {
            t.tensor(n).unwrap().data().chunks_exact(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect()
        };
        let g = Gaussians {
            means: triples(&get("means")),
            log_scales: triples(&get("scales")),
            rotations: triples(&get("quats")),
            opacity_logits: get("opacities"),
            sh: get("coeffs"),
            sh_degree: 3,
            ..Gaussians::default()
        };
        let shape = t.tensor("out_img").unwrap().shape().to_vec();
        let (h, w) = (shape[0] as u32, shape[1] as u32);
        let camera = Camera {
            width: w,
            height: h,
            fx: f64::from(w) / 2.0,
            fy: f64::from(w) / 2.0,
            cx: f64::from(w) / 2.0,
            cy: f64::from(h) / 2.0,
            rotation: DMat3::IDENTITY,
            translation: DVec3::new(-0.123, -0.456, 8.0),
        };
        let r = render(&g, &camera, &RasterOptions::default());
        let ours: Vec<f32> = r.rgb.chunks_exact(3).zip(&r.alpha).flat_map(|(c, a)| [c[0], c[1], c[2], *a]).collect();
        let error = worst(&ours, &get("out_img"));
        eprintln!("{name}: largest difference {error:e}");
        assert!(error <= 1e-4, "{name}: {error}");
    }
}

#[test]
#[ignore = "needs shared/data/oracle; run make test-data"]
fn matches_the_f64_oracle_forward_and_backward() {
    for name in ["case_a", "case_b"] {
        let file = std::fs::File::open(data(&format!("{name}.npz"))).unwrap();
        let mut zip = zip::ZipArchive::new(file).unwrap();
        let mut arrays: HashMap<String, Vec<f32>> = HashMap::new();
        for i in 0..zip.len() {
            let mut f = zip.by_index(i).unwrap();
            let mut bytes = Vec::new();
            f.read_to_end(&mut bytes).unwrap();
            if let Ok(a) = gs_io::npy::parse(&bytes) {
                arrays.insert(f.name().unwrap().trim_end_matches(".npy").to_string(), a.into_iter().collect());
            }
        }
        let get = |n: &str| arrays.get(n).unwrap_or_else(|| panic!("no {n} in {:?}", arrays.keys()));
        let g = Gaussians {
            means: triples(get("means")),
            log_scales: triples(&get("scales").iter().map(|s| s.ln()).collect::<Vec<_>>()),
            rotations: triples(get("quats")),
            opacity_logits: get("opacities").iter().map(|o| (o / (1.0 - o)).ln()).collect(),
            sh: get("sh").clone(),
            sh_degree: 3,
            ..Gaussians::default()
        };
        let m: Vec<f64> = get("viewmat").iter().map(|&v| f64::from(v)).collect();
        let k = get("K");
        let camera = Camera {
            width: get("width")[0] as u32,
            height: get("height")[0] as u32,
            fx: f64::from(k[0]),
            fy: f64::from(k[4]),
            cx: f64::from(k[2]),
            cy: f64::from(k[5]),
            rotation: DMat3::from_cols_array(&[m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]]).transpose(),
            translation: DVec3::new(m[3], m[7], m[11]),
        };
        let background: [f32; 3] = get("background")[..3].try_into().unwrap();
        let options = RasterOptions { background, ..RasterOptions::default() };
        let mut workspace = Workspace::default();
        let r = &workspace.forward(&g, &camera, &options).rendered;
        let (rgb, alpha) = (worst(&r.rgb, get("out_rgb")), worst(&r.alpha, get("out_alpha")));
        let depth = relative(&r.depth, get("out_depth"));
        eprintln!("{name}: rgb {rgb:e} alpha {alpha:e} depth {depth:e}");
        assert!(rgb <= 1e-4 && alpha <= 1e-4 && depth <= 1e-3, "{name}: {rgb} {alpha} {depth}");

        // The oracle's loss: mean |rgb - target| + 0.1 mean (alpha - 0.5)^2 + 0.05 mean (depth - target)^2.
        let pixels = r.alpha.len() as f32;
        let d_rgb: Vec<f32> =
            r.rgb.iter().zip(get("target_rgb")).map(|(a, b)| (a - b).signum() / (3.0 * pixels)).collect();
        let d_alpha: Vec<f32> = r.alpha.iter().map(|a| 0.2 * (a - 0.5) / pixels).collect();
        let d_depth: Vec<f32> = r.depth.iter().zip(get("target_depth")).map(|(a, b)| 0.1 * (a - b) / pixels).collect();
        let d = PixelGradients { rgb: &d_rgb, alpha: Some(&d_alpha), depth: Some(&d_depth) };
        let d = workspace.backward(&g, &camera, &options, d);
        let groups = [
            ("means", d.means.as_flattened(), get("grad_means")),
            ("quats", d.rotations.as_flattened(), get("grad_quats")),
            ("log scales", d.log_scales.as_flattened(), get("grad_log_scales")),
            ("logits", &d.opacity_logits[..], get("grad_logit_opac")),
            ("sh", &d.sh[..], get("grad_sh")),
        ];
        for (group, ours, theirs) in groups {
            let error = relative(ours, theirs);
            eprintln!("{name}: gradient of {group}: relative difference {error:e}");
            assert!(error <= 1e-3, "{name}: {group}: {error}");
        }
    }
}
