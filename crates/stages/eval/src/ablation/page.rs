//! Tables of an ablation on a page.

use super::tables::{Table, blocks, remark};
use report::html::Page;

/// A section for each table.
pub fn sections(page: &mut Page, tables: &[Table]) {
    for table in tables {
        page.section(&format!("ablation-{}", table.name), &table.title);
        for (title, head, rows) in blocks(table) {
            page.heading(&title, "");
            let head: Vec<&str> = head.iter().map(String::as_str).collect();
            page.table(&head, &rows);
        }
        page.paragraph(&remark(table));
    }
}
