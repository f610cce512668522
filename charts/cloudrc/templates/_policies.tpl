{{/* Parts of NetworkPolicies. */}}

{{- define "cloudrc.dns" -}}
- to:
    {{- toYaml .Values.networkPolicy.dns | nindent 4 }}
  ports:
    - {port: {{ .Values.networkPolicy.dnsPort }}, protocol: UDP}
    - {port: {{ .Values.networkPolicy.dnsPort }}, protocol: TCP}
{{- end }}

{{/* The tunnel to or from the other end. Argument: (dict "root" $ "component" PEER "way" "from"|"to"). */}}
{{- define "cloudrc.tunnel" -}}
- {{ .way }}:
    - podSelector:
        matchLabels:
          {{- include "cloudrc.selector" . | nindent 10 }}
  ports:
    - {port: 7400, protocol: UDP}
{{- end }}

{{/* `helm test` reads the metrics of world, cloud and the link containers. */}}
{{- define "cloudrc.linkTest" -}}
- from:
    - podSelector:
        matchLabels:
          {{- include "cloudrc.selector" (dict "root" . "component" "test") | nindent 10 }}
  ports:
    - {port: 9100, protocol: TCP}
    - {port: 9102, protocol: TCP}
{{- end }}

{{/* Scraping, if metrics.allowFrom is set. Argument: (dict "root" $ "ports" LIST). */}}
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
