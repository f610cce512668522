{{/* Parts of NetworkPolicies. */}}

{{- define "cloudrc.dns" -}}
- to:
    {{- toYaml .Values.networkPolicy.dns | nindent 4 }}
  ports:
    - {port: 53, protocol: UDP}
    - {port: 53, protocol: TCP}
{{- end }}

{{/* The tunnel to or from the other end: takes (dict "root" $ "component" PEER "way" "from"|"to"). */}}
{{- define "cloudrc.tunnel" -}}
- {{ .way }}:
    - podSelector:
        matchLabels:
          {{- include "cloudrc.selector" . | nindent 10 }}
  ports:
    - {port: 7400, protocol: UDP}
{{- end }}

{{/* `helm test` asks both ends what they hear of the link, and the link containers what they do. */}}
{{- define "cloudrc.linkTest" -}}
- from:
    - podSelector:
        matchLabels:
          {{- include "cloudrc.selector" (dict "root" . "component" "test") | nindent 10 }}
  ports:
    - {port: 9100, protocol: TCP}
    - {port: 9102, protocol: TCP}
{{- end }}

{{/* Scraping, where somebody is admitted: takes (dict "root" $ "ports" LIST). */}}
{{- define "cloudrc.scrape" -}}
{{- with .root.Values.metrics.allowFrom }}
- from:
    {{- toYaml . | nindent 4 }}
  ports:
    {{- range $.ports }}
    - {port: {{ . }}, protocol: TCP}
    {{- end }}
{{- end }}
{{- end }}
